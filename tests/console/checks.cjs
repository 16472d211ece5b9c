// What is tried apart from the story: other pointers, the pointing task, slow pages, no picture, who cannot see.

const assert = require("node:assert/strict");
const { readFileSync } = require("node:fs");
const { Person, arc, distance, ease, finger, pen } = require("./person.cjs");

/** A finger and a pen drive as the mouse does; lifting it lets go, and so does a gesture that is taken away. */
async function pointers(browser, url, shots) {
  const person = await Person.at(browser, url, shots, { viewport: { width: 400, height: 820 }, hasTouch: true });
  const { page } = person;
  await person.state("Ready");
  await person.picture("narrow-light");
  await page.evaluate(() => {
    globalThis.pointed = new Set();
    document.getElementById("scene").addEventListener("pointerdown", (event) => pointed.add(event.pointerType));
  });
  const touch = await finger(page);
  for (const [kind, pointer, end] of [["touch", touch, touch.up], ["touch", touch, touch.cancel], ["pen", await pen(page)]]) {
    person.pointer = pointer;
    const before = await person.now("arm.tip");
    await person.drives(600, (u) => arc(u).map((v) => 0.4 * (end === touch.cancel ? -v : v)));
    assert.ok(distance(await person.now("arm.tip"), before) > 0.05, `${kind}: the arm went somewhere`);
    await (end ?? pointer.up)();
    await person.state("Ready");
    assert.equal(await person.now("you"), null, `${kind}: lifted or taken away, it has let go`);
  }
  assert.deepEqual(await page.evaluate(() => [...pointed]), ["touch", "pen"]);

  // Two fingers beside the hand come closer, and hold nothing.
  const far = await page.evaluate(() => telemime.view.distance);
  const cdp = await page.context().newCDPSession(page);
  const two = (type, apart) => cdp.send("Input.dispatchTouchEvent", { type, touchPoints: apart ? [{ x: 40, y: 150, id: 1 }, { x: 40 + apart, y: 150, id: 2 }] : [] });
  await two("touchStart", 60);
  for (let apart = 60; apart <= 120; apart += 10) await two("touchMove", apart);
  await two("touchEnd");
  await person.until((far) => telemime.view.distance < 0.8 * far, far);
  assert.equal(await person.now("driving"), null);

  // Scrolled to the end, state and Stop are still in sight.
  await page.evaluate(() => scrollTo(0, document.body.scrollHeight));
  for (const id of ["state", "stop"]) {
    const seen = await page.evaluate((id) => {
      const { left, top, width, height } = document.getElementById(id).getBoundingClientRect();
      const found = document.elementFromPoint(left + Math.min(20, width / 2), top + height / 2);
      return document.getElementById(id).contains(found);
    }, id);
    assert.ok(seen, `${id} is in sight of a small screen`);
  }
  await person.picture("narrow-scrolled");
  assert.deepEqual(person.wrong, []);
  await person.close();
}

/** What the standard's arithmetic gives for movements that are known. */
async function throughput(page) {
  const found = await page.evaluate(async () => {
    const { order, throughput } = await import("./fitts.js");
    // 0.15 m along x; misses −2, 0, 2 mm: deviation 2 mm.
    const trial = (miss) => ({ from: [0, 0, 0], to: [0.15, 0, 0], end: [0.15 + miss, 0.01, 0], time_s: 0.5 });
    return { order: order(9), result: throughput([-0.002, 0, 0.002].map(trial)) };
  });
  assert.deepEqual(found.order, [0, 5, 1, 6, 2, 7, 3, 8, 4, 0], "always across the circle");
  const width = 4.133 * 0.002;
  assert.ok(Math.abs(found.result.width - width) < 1e-9);
  assert.ok(Math.abs(found.result.distance - 0.15) < 1e-9);
  assert.ok(Math.abs(found.result.throughput - Math.log2(0.15 / width + 1) / 0.5) < 1e-9);
}

/** The whole pointing task, with five circles: both sequences, the table, and a CSV from which the table can be computed. */
async function task(person) {
  const { page } = person;
  await person.home();
  await page.click("#fitts > summary");
  await page.selectOption("#circles", "5");
  await page.selectOption("#width", "0.04");
  await page.click("#fitts-start");
  const gains = new Set();
  let pictured = false;
  for (let ways = 0; ways < 60; ways++) {
    const seen = await page.evaluate(() => {
      const { run } = telemime.fitts;
      return run && { at: run.at, gain: run.gain, held: telemime.drive.what !== null };
    });
    if (!seen) break;
    if (!seen.held) {
      await page.mouse.up();
      await person.engages();
    }
    gains.add(seen.gain);
    assert.ok(await page.isDisabled("#predict"), "prediction is the task's, meanwhile");
    const way = await page.evaluate(() => {
      const { drive, fitts, link, view } = telemime;
      if (!drive.p || !fitts.run) return null;
      const { places, lit } = fitts.targets;
      const at = drive.p.map((v, i) => v + link.now.offset[i]);
      const [from, to] = [view.project(at), view.project(places[lit])];
      return [to.x - from.x, to.y - from.y];
    });
    if (!way) continue;
    await person.move(person.last, 450, (u) => way.map((v) => v * ease(u)));
    await person.until((at) => {
      const { drive, fitts } = telemime;
      return !fitts.run || fitts.run.at !== at || drive.what === null;
    }, seen.at);
    if (seen.at === 2 && !pictured) {
      pictured = true;
      await person.picture("fitts-light", (now) => now.robot.state === "Engaged", "fitts");
    }
  }
  await person.released();
  assert.deepEqual([...gains].sort(), [0, 1], "with prediction and without");
  assert.equal(await person.now("gain"), 1, "prediction is as it was");
  const [file] = await Promise.all([page.waitForEvent("download"), page.click("#fitts-csv")]);
  const [head, ...lines] = readFileSync(await file.path(), "utf8").trim().split("\n").map((line) => line.split(","));
  const rows = lines.map((line) => Object.fromEntries(line.map((v, i) => [head[i], Number(v)])));
  const table = await page.locator("#fitts-table tbody tr").allInnerTexts();
  assert.equal(table.length, 2);
  for (const [i, line] of table.entries()) {
    const mine = rows.filter((row) => row.sequence === i + 1);
    const mean = (key) => mine.reduce((sum, row) => sum + row[key], 0) / mine.length;
    const middle = mean("miss_m");
    const width = 4.133 * Math.sqrt(mine.reduce((sum, row) => sum + (row.miss_m - middle) ** 2, 0) / (mine.length - 1));
    const bits = Math.log2((mean("distance_m") + middle) / width + 1) / mean("time_s");
    assert.ok(mine.length >= 3 && mine.length <= 5 && mine.every((row) => row.circles === 5 && row.width_m === 0.04 && row.time_s > 0));
    assert.ok(mine.every((row) => Math.abs(row.miss_m) <= 0.02 && row.distance_m > 0.08 && row.distance_m < 0.2));
    assert.ok(Math.abs(bits / mine[0].throughput_bit_s - 1) < 0.02, `${bits} bit/s of the CSV, ${mine[0].throughput_bit_s} in it`);
    const [prediction, time, , shown] = line.split("\t");
    assert.equal(prediction, mine[0].prediction ? "on" : "off");
    // Each is rounded for itself, the table's to 0.01 and the CSV's to 0.001.
    assert.ok(Math.abs(Number(shown) - mine[0].throughput_bit_s) < 0.0056, `${shown} bit/s shown, ${mine[0].throughput_bit_s} in the CSV`);
    assert.ok(Math.abs(Number(time) - mean("time_s")) < 0.006);
  }
  assert.match(await person.text("fitts-say"), /Done: [\d.]+ bit\/s with prediction, [\d.]+ without/);
  await person.picture("fitts-result-light", null, "fitts");
  await page.click("#fitts > summary");
  console.log(`  ${await person.text("fitts-say")}`);
}

/** Without WebGL: a note in place of the picture, and everything else. */
async function blind(chromium, executablePath, url, shots) {
  const browser = await chromium.launch({ executablePath, args: ["--no-sandbox", "--disable-gpu", "--disable-3d-apis"] });
  try {
    const person = await Person.at(browser, url, shots);
    const { page } = person;
    await person.state("Ready");
    assert.equal(await page.evaluate(() => telemime.scene), null, "there is no WebGL");
    assert.ok(await page.isVisible("#plain"));
    assert.match(await person.text("plain"), /No picture.*hold the space bar/s);
    assert.match(await person.text("log"), /no picture/);
    await person.until(() => document.getElementById("state-name").textContent === "Ready");
    await page.focus("#scene");
    await page.keyboard.down(" ");
    await person.state("Engaged");
    const from = await person.now("arm.tip");
    await page.keyboard.down("ArrowUp");
    await person.until((z) => telemime.link.now.arm.tip[2] > z + 0.03, from[2]);
    await person.until(() => document.getElementById("age").textContent.endsWith("ms"));
    await page.keyboard.up("ArrowUp");
    await person.picture("no-webgl", (now) => now.robot.state === "Engaged");
    await page.keyboard.press("Escape");
    await person.state("Stopped");
    await page.keyboard.up(" ");
    await person.until(() => document.getElementById("why").textContent === "stopped from here");
    await page.click("#reset");
    await person.state("Ready");
    // Nobody takes hold of what is not shown.
    await page.mouse.move(8, 60);
    await page.mouse.down();
    assert.equal(await page.evaluate(() => telemime.drive.what), null);
    await page.mouse.up();
    assert.deepEqual(person.wrong, []);
  } finally {
    await browser.close();
  }
}

/** Graphics that are taken away while the hand is dragged: let go, said, and back when they are. */
async function dimmed(person) {
  const { page } = person;
  await person.engages();
  await page.evaluate(() => {
    globalThis.lose = telemime.scene.renderer.gl.getExtension("WEBGL_lose_context");
    lose.loseContext();
  });
  await person.until(() => !document.getElementById("plain").hidden);
  await person.state("Ready");
  await page.mouse.up();
  await page.evaluate(() => lose.restoreContext());
  await person.until(() => document.getElementById("plain").hidden && telemime.scene);
}

/**
 * A page that the machine starves, one that hangs, and one that reads nothing (`asleep`): the arm follows whoever drives,
 * and reports as often as without them. A driver's page that is starved drives on, or has let go.
 */
async function slow(person, other, reader, asleep) {
  await person.home();
  reader.rate();
  await person.drives(1200, (u) => [-70 * ease(u), 30 * ease(u)]);
  await person.released();
  const before = reader.rate();
  const starved = await other.page.context().newCDPSession(other.page);
  await starved.send("Emulation.setCPUThrottlingRate", { rate: 20 });
  const hangs = other.page.evaluate(() => { const until = performance.now() + 1500; while (performance.now() < until); });
  await person.drives(1200, (u) => [70 * ease(u), -30 * ease(u)]);
  await person.released();
  const beside = reader.rate();
  await hangs;
  await starved.send("Emulation.setCPUThrottlingRate", { rate: 1 });
  const own = await person.page.context().newCDPSession(person.page);
  await own.send("Emulation.setCPUThrottlingRate", { rate: 4 });
  const at = await person.engages();
  await person.move(at, 1200, (u) => [-60 * ease(u), 0]);
  await own.send("Emulation.setCPUThrottlingRate", { rate: 1 });
  await person.released();
  const within = reader.rate();
  const rates = [before, beside, within].map((rate) => rate.toFixed(1)).join(", ");
  console.log(`  reports of the arm a second while it follows: ${rates} (none slow, others slow, the driver slow)`);
  assert.ok(Math.min(beside, within) > 0.8 * before, rates);
  assert.ok(asleep.bytesRead < 300_000, `it read nothing, but for ${asleep.bytesRead} bytes`);
}

/** By name and role, for who cannot see it. */
async function accessible(person) {
  const { page } = person;
  const cdp = await page.context().newCDPSession(page);
  const { nodes } = await cdp.send("Accessibility.getFullAXTree");
  const seen = nodes.filter((node) => !node.ignored).map((node) => ({ role: node.role?.value, name: node.name?.value ?? "", node }));
  const scene = seen.filter(({ role }) => role === "application");
  assert.equal(scene.length, 1);
  for (const key of ["space bar", "arrow keys", "Page Up", "Shift", "Escape"]) assert.ok(scene[0].name.includes(key), `the picture's name tells of ${key}`);
  const asks = new Set(["button", "switch", "checkbox", "slider", "combobox", "textbox", "application", "DisclosureTriangle", "region", "log"]);
  const nameless = seen.filter(({ role, name }) => asks.has(role) && !name.trim());
  assert.deepEqual(nameless.map(({ role }) => role), [], "everything that can be used has a name");
  const names = seen.map(({ role, name }) => `${role}: ${name}`);
  for (const is of [/^button: Hold to run/, /^button: Stop/, /^switch: Prediction/, /^switch: Record/, /^slider: Delay one way/, /^combobox: Skill/, /^textbox: Name/]) {
    assert.ok(names.some((name) => is.test(name)), `${is} in ${names.join(" | ")}`);
  }
  const images = seen.filter(({ role }) => role === "image").map(({ name }) => name);
  assert.ok(images.some((name) => /^Age: /.test(name)) && images.some((name) => /^State: /.test(name)), `what the plots say: ${images}`);
}

/** Text against what is behind it, after WCAG 2 (1.4.3); what cannot be used now is exempt. */
async function readable(person, theme) {
  const faint = await person.page.evaluate(() => {
    const pen = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
    const rgba = (colour) => {
      pen.clearRect(0, 0, 1, 1);
      pen.fillStyle = colour;
      pen.fillRect(0, 0, 1, 1);
      return [...pen.getImageData(0, 0, 1, 1).data];
    };
    const light = (c) => [0.2126, 0.7152, 0.0722].reduce((sum, w, i) => {
      const v = c[i] / 255;
      return sum + w * (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    }, 0);
    const over = (top, below, a) => below.map((v, i) => v + (top[i] - v) * a);
    const behind = (element) => {
      const chain = [];
      for (let at = element; at; at = at.parentElement) chain.unshift(getComputedStyle(at).backgroundColor);
      return chain.reduce((below, colour) => {
        const c = rgba(colour);
        return over(c, below, c[3] / 255);
      }, [255, 255, 255]);
    };
    const found = [];
    const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walk.nextNode()) {
      const element = walk.currentNode.parentElement;
      if (!walk.currentNode.textContent.trim() || !element.checkVisibility({ opacityProperty: true }) || element.closest(":disabled, .skip")) continue;
      const style = getComputedStyle(element);
      const ground = behind(element);
      let opacity = 1;
      for (let at = element; at; at = at.parentElement) opacity *= getComputedStyle(at).opacity;
      const ink = over(rgba(style.color), ground, opacity);
      const [a, b] = [light(ink), light(ground)].sort((x, y) => y - x);
      const contrast = (a + 0.05) / (b + 0.05);
      if (contrast < 4.5) found.push(`${walk.currentNode.textContent.trim().slice(0, 30)}: ${contrast.toFixed(2)}`);
    }
    return found;
  });
  assert.deepEqual(faint, [], `${theme}: every text has a contrast of 4.5`);
}

module.exports = { accessible, blind, dimmed, pointers, readable, slow, task, throughput };
