// A person at the console page, played by a script, and the demonstration that serves the page.

const assert = require("node:assert/strict");
const { spawn } = require("node:child_process");
const { join } = require("node:path");
const { createInterface } = require("node:readline");

const SOON = { timeout: 30_000 };
/** A tip that follows ends up this near to a hand that rests, m. */
const NEAR = 0.012;

function demo(program, shots) {
  const child = spawn(program, ["demo", "--console", "127.0.0.1:0", "--json", "--delay", "60ms", "--jitter", "5ms", "--out", join(shots, "run")], { stdio: ["pipe", "pipe", "inherit"] });
  const url = new Promise((found, failed) => {
    child.once("exit", (code) => failed(new Error(`the demonstration ended: ${code}`)));
    createInterface({ input: child.stdout }).on("line", (line) => {
      const event = JSON.parse(line);
      if (event.event === "console") found(event.url);
    });
  });
  return { child, url };
}

const mouse = (page) => ({
  async down(x, y) {
    await page.mouse.move(x, y);
    await page.mouse.down();
  },
  move: (x, y) => page.mouse.move(x, y),
  up: () => page.mouse.up(),
});

/** A finger; `up` lifts it, `cancel` is the system taking the gesture away. */
async function finger(page) {
  const cdp = await page.context().newCDPSession(page);
  const touch = (type, ...touchPoints) => cdp.send("Input.dispatchTouchEvent", { type, touchPoints });
  return {
    down: (x, y) => touch("touchStart", { x, y }),
    move: (x, y) => touch("touchMove", { x, y }),
    up: () => touch("touchEnd"),
    cancel: () => touch("touchCancel"),
  };
}

async function pen(page) {
  const cdp = await page.context().newCDPSession(page);
  const say = (type, x, y, buttons) => cdp.send("Input.dispatchMouseEvent", { type, x, y, buttons, button: type === "mouseMoved" && !buttons ? "none" : "left", clickCount: 1, pointerType: "pen" });
  let at = [0, 0];
  return {
    async down(x, y) {
      at = [x, y];
      await say("mouseMoved", x, y, 0);
      await say("mousePressed", x, y, 1);
    },
    move: (x, y) => say("mouseMoved", ...(at = [x, y]), 1),
    up: () => say("mouseReleased", ...at, 0),
  };
}

class Person {
  static async at(browser, url, shots, options = {}) {
    const page = await browser.newPage({ viewport: { width: 1000, height: 680 }, colorScheme: "light", reducedMotion: "reduce", ...options });
    const person = new Person();
    Object.assign(person, { page, shots, wrong: [], pointer: mouse(page) });
    const wrong = (text) => {
      console.error(`  in the page: ${text}`);
      person.wrong.push(text);
    };
    page.on("pageerror", (error) => wrong(error.message));
    page.on("console", (message) => message.type() === "error" && wrong(message.text()));
    await page.goto(url);
    await person.until(() => globalThis.telemime?.link.now?.linked && telemime.tip());
    await person.coarse();
    person.start = await person.now("arm.tip");
    return person;
  }

  until(is, what, within = SOON) {
    return this.page.waitForFunction(is, what, within);
  }

  /** As coarse a picture as a machine without graphics would settle on by itself, at once. */
  coarse() {
    return this.page.evaluate(() => Object.assign(telemime.scene ?? {}, { quality: 0.35, pace: 16 }));
  }

  now(key) {
    return this.page.evaluate((key) => key.split(".").reduce((at, k) => at?.[k], telemime.link.now), key);
  }

  text(id) {
    return this.page.evaluate((id) => document.getElementById(id).textContent, id);
  }

  async state(state) {
    await this.until((state) => telemime.link.now?.robot?.state === state, state);
  }

  async noted(text) {
    await this.until((text) => telemime.link.now?.notes.some(([, note]) => note.includes(text)), text);
  }

  /** Sets the link, as the sliders do but beyond their ends. */
  async link(delay_ms, loss_percent = 0) {
    await this.page.evaluate((shape) => telemime.link.say({ do: "link", jitter_ms: 5, ...shape }), { delay_ms, loss_percent });
  }

  /**
   * A picture, with `is` of the first snapshot for which that holds: the page then hears nothing until the picture is
   * taken, however long this machine takes to draw it.
   */
  async picture(name, is, where) {
    if (is) {
      await this.page.evaluate(`new Promise((done, failed) => {
        const { link } = telemime;
        setTimeout(() => failed(new Error(${JSON.stringify(`never as in ${name}.png`)})), ${SOON.timeout});
        link.take = function (message) {
          Object.getPrototypeOf(link).take.call(link, message);
          if (!link.now || !(${is})(link.now)) return;
          link.take = () => {};
          done();
        };
      })`);
    }
    await this.page.evaluate(async (where) => {
      if (where) document.getElementById(where).scrollIntoView({ block: "end" });
      Object.assign(telemime.scene ?? {}, { quality: 1, pace: -1000, next: 0 });
      await new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)));
    }, where);
    await this.page.screenshot({ path: join(this.shots, `${name}.png`) });
    await this.coarse();
    if (is) await this.page.evaluate(() => delete telemime.link.take);
  }

  /** Takes hold of the hand in the picture; returns where. */
  async grab() {
    const at = await this.page.evaluate(() => {
      const { left, top } = document.getElementById("scene").getBoundingClientRect();
      const { x, y } = telemime.view.project(telemime.tip());
      return [x + left, y + top];
    });
    await this.pointer.down(...at);
    this.last = at;
    return at;
  }

  /** Moves along `path(u)`, u from 0 to 1, in about `ms`. */
  async move([x, y], ms, path) {
    const begun = performance.now();
    let u = 0;
    while (u < 1) {
      u = Math.min(1, (performance.now() - begun) / ms);
      const [dx, dy] = path(u);
      this.last = [x + dx, y + dy];
      await this.pointer.move(...this.last);
    }
  }

  /** Waits until the tip is where the hand is shown; `false` if the clutch is let go before. */
  async arrives(within = NEAR) {
    const seen = await this.until((within) => {
      const { hand, arm, robot, you, offset } = telemime.link.now ?? {};
      const { p } = telemime.drive;
      const apart = (a, b) => Math.hypot(...a.map((v, i) => v - b[i]));
      // Of the hand that is told, and not of one that the daemon has yet to hear of.
      const told = hand && p && apart(hand.p, p.map((v, i) => v + offset[i])) < 1e-3;
      if (told && apart(hand.p, arm.tip) < within) return "near";
      return you === null && robot.state === "Ready" && "let go";
    }, within);
    return (await seen.jsonValue()) === "near";
  }

  /** Takes hold of the hand and has the clutch, at the latest the fifth time: a page that stalls for 0.2 s has let go, and a busy machine's does. */
  async engages() {
    for (let tries = 1; tries <= 5; tries++) {
      const at = await this.grab();
      const seen = await this.until(() => {
        const { robot, you } = telemime.link.now ?? {};
        if (robot?.state === "Engaged" && you === true) return "engaged";
        return telemime.drive.what === null && robot?.state === "Ready" && "let go";
      });
      if ((await seen.jsonValue()) === "engaged") return at;
      await this.catchesUp();
    }
    assert.fail("the clutch was let go five times before the arm followed");
  }

  /** Lets go, and waits until a page that was behind shows where the arm is now: who takes hold of where it was would add that way to the next. */
  async catchesUp() {
    await this.pointer.up();
    await this.until((t) => telemime.link.now?.arm?.t > t + 1000, await this.now("arm.t"));
  }

  /** Drags the hand along `path` until the arm is there, still holding it; to the same place however often it is let go on the way. */
  async drives(ms, path) {
    let begun;
    for (let tries = 1; tries <= 5; tries++) {
      const at = await this.engages();
      begun ??= at;
      await this.move(at, ms, towards(begun, at, path));
      if (await this.arrives()) return;
      console.log(`  let go by a page that was silent for too long (${tries})`);
      await this.catchesUp();
    }
    assert.fail("the clutch was let go five times");
  }

  /** Drags the arm to where it began, so that what follows does not come to the end of its reach. */
  async home() {
    const by = await this.page.evaluate((home) => {
      const [from, to] = [telemime.tip(), home].map((p) => telemime.view.project(p));
      return [to.x - from.x, to.y - from.y];
    }, this.start);
    await this.drives(800, (u) => by.map((v) => v * ease(u)));
    await this.released();
  }

  /** Lets go, and waits until the arm is. */
  async released() {
    await this.pointer.up();
    await this.state("Ready");
  }

  /** A picture while the hand is dragged along `path`; whether the clutch is still held after it does not matter. */
  async pictured(name, is, ms, path) {
    const taken = this.picture(name, is);
    let begun;
    for (let seen = false; !seen; ) {
      const at = await this.engages();
      begun ??= at;
      await this.move(at, ms, towards(begun, at, path));
      const letGo = this.until(() => telemime.drive.what === null).then(() => false, () => false);
      seen = await Promise.race([taken.then(() => true), letGo]);
      await this.released();
      if (!seen) await this.catchesUp();
    }
  }

  async close() {
    await this.page.context().close();
  }
}

const ease = (u) => u * u * u * (10 - 15 * u + 6 * u * u);
const arc = (u) => [90 * ease(u), -60 * Math.sin(Math.PI * ease(u))];
/** `path` from `begun`, for who takes hold at `at`: what was cut short and is tried again does not add up, and ends in the arm's reach. */
const towards = (begun, at, path) => (u) => path(u).map((v, i) => v + (begun[i] - at[i]) * ease(u));
const distance = (a, b) => Math.hypot(...a.map((v, i) => v - b[i]));

module.exports = { NEAR, Person, SOON, arc, demo, distance, ease, finger, pen, towards };
