// Hold-to-run: pointer, keys and buttons that move the hand, and let go.

import { add, along, norm, scale } from "./math.js";

const ORBIT = 0.006;
const KEY_SPEED = 0.16;
const KEY_FINE = 0.04;
const WHEEL_M = 0.0004;
const MOVES = {
  ArrowLeft: ["right", -1], ArrowRight: ["right", 1], ArrowUp: ["up", 1], ArrowDown: ["up", -1],
  PageUp: ["forward", 1], PageDown: ["forward", -1],
};

export class Drive extends EventTarget {
  /** `tip()` is where the arm's tip is shown. */
  constructor(link, view, canvas, tip) {
    super();
    Object.assign(this, { link, view, canvas, tip });
    this.p = null;
    this.what = null;
    this.granted = false;
    this.recording = false;
    this.blind = false;
    this.owed = false;
    this.said = 0;
    this.keys = new Set();
    this.pointers = new Map();
    this.grabbed = null;
    this.pointing();
    this.typing();
    link.addEventListener("now", (event) => this.heard(event.detail));
    link.addEventListener("link", ({ detail }) => {
      this.lost();
      if (detail.open && this.owed) this.stop();
    });
    const away = () => this.end();
    addEventListener("blur", away);
    addEventListener("pagehide", away);
    document.addEventListener("visibilitychange", () => document.hidden && away());
  }

  /** Presses the clutch: "hand" drives, "play" plays `skill`, and while Record is on the arm stays. */
  begin(what, skill) {
    const tip = this.tip();
    if (this.what || !this.link.open || !tip) return false;
    this.what = what === "hand" && this.recording ? "record" : what;
    this.granted = false;
    this.begun = performance.now();
    this.p = tip;
    this.link.say({ do: "hold", what: this.what, skill, t: performance.now(), x: this.p });
    this.changed();
    return true;
  }

  end() {
    this.keys.clear();
    this.grabbed = null;
    this.canvas.classList.remove("driving");
    if (!this.what) return;
    this.link.say({ do: "release" });
    this.lost();
  }

  /** The emergency stop: owed until the robot is seen to have stopped, and said again by every connection until then. */
  stop() {
    this.owed = true;
    if (!this.link.say({ do: "stop" })) this.dispatchEvent(new Event("owed"));
    this.end();
  }

  lost() {
    this.what = null;
    this.grabbed = null;
    this.changed();
  }

  heard({ you, linked, robot }) {
    if (linked && robot?.state === "Stopped") this.owed = false;
    if (!this.what) return;
    // Whoever let go at the other end, the clutch must be pressed anew.
    if (this.granted && you !== true) this.end();
    this.granted ||= you === true;
    // Refused: the log says why.
    if (!this.granted && performance.now() - this.begun > 1500) this.lost();
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }

  /** Some 100 times a second: the keys move the hand, and the daemon hears that the clutch is still held. */
  tick(now) {
    const dt = Math.min(0.05, (now - this.said) / 1000);
    if (!this.what || now - this.said < 7.5) return;
    this.said = now;
    for (const key of this.keys) {
      const [axis, sign] = MOVES[key];
      this.p = along(this.p, this.view[axis], sign * (this.fine ? KEY_FINE : KEY_SPEED) * dt);
    }
    const said = this.what === "play" ? { do: "alive" } : { do: "hand", t: now, x: this.p };
    this.link.say(said, false);
  }

  /** A button that does `what` as long as it is pressed, by pointer or key. */
  button(element, begin) {
    element.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      element.setPointerCapture(event.pointerId);
      begin();
    });
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) element.addEventListener(kind, () => this.end());
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      event.stopPropagation();
      if (!event.repeat) begin();
    });
    element.addEventListener("keyup", (event) => (event.key === "Enter" || event.key === " ") && this.end());
    element.addEventListener("blur", () => this.end());
  }

  near(event) {
    const tip = this.tip();
    if (!tip || this.blind) return false;
    const at = this.view.project(tip);
    return Math.hypot(at.x - event.offsetX, at.y - event.offsetY) < (event.pointerType === "mouse" ? 26 : 44);
  }

  pointing() {
    const { canvas, pointers } = this;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      // A pointer that took hold of the hand never turns the picture, even when the hand is let go for it.
      const hand = pointers.size === 0 && event.button === 0 && this.near(event);
      pointers.set(event.pointerId, [event.clientX, event.clientY, hand]);
      if (hand && this.begin("hand")) {
        this.grabbed = event.pointerId;
        canvas.classList.add("driving");
      }
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return canvas.classList.toggle("near", this.near(event));
      const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
      const others = [...pointers].filter(([id, [, , hand]]) => id !== event.pointerId && !hand);
      const hand = before[2];
      pointers.set(event.pointerId, [event.clientX, event.clientY, hand]);
      if (hand) {
        if (this.what && event.pointerId === this.grabbed) this.p = add(this.p, this.view.drag(this.p, dx, dy));
      } else if (others.length) {
        const [, [x, y]] = others[0];
        const apart = (p) => Math.hypot(p[0] - x, p[1] - y) || 1;
        this.view.zoom(apart(before) / apart([event.clientX, event.clientY]));
      } else {
        this.view.orbit(dx * ORBIT, dy * ORBIT);
      }
    });
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => {
        pointers.delete(event.pointerId);
        if (event.pointerId === this.grabbed) this.end();
      });
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (this.what && this.what !== "play") this.p = along(this.p, this.view.forward, -event.deltaY * WHEEL_M);
      else this.view.zoom(Math.exp(event.deltaY * 0.001));
    }, { passive: false });
  }

  typing() {
    addEventListener("keydown", (event) => {
      if (event.key === "Escape") return event.repeat || this.stop();
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const field = event.target.closest?.("input:not([type=checkbox]), select, textarea");
      this.fine = event.shiftKey;
      if (event.key === " " && !field && !event.target.closest?.("button, summary, input")) {
        event.preventDefault();
        if (!event.repeat) this.begin("hand");
      } else if (MOVES[event.key] && this.what && !field) {
        event.preventDefault();
        this.keys.add(event.key);
      } else if (MOVES[event.key] && event.target === this.canvas) {
        event.preventDefault();
        const [axis, sign] = MOVES[event.key];
        if (axis === "forward") this.view.zoom(1 - 0.1 * sign);
        else this.view.orbit(axis === "right" ? 0.1 * sign : 0, axis === "up" ? 0.08 * sign : 0);
      }
    });
    addEventListener("keyup", (event) => {
      this.keys.delete(event.key);
      this.fine = event.shiftKey;
      if (event.key === " " && this.grabbed === null) this.end();
    });
  }
}

/** The hand's path of late, on the daemon's clock: for the ghost, the trail and the lag. */
export class History {
  constructor(keep_ms = 3500) {
    this.keep = keep_ms;
    this.all = [];
  }

  take(t, p) {
    const last = this.all.at(-1);
    if (last && t < last.t) this.all = [];
    if (last && t === last.t) return;
    this.all.push({ t, p });
    while (this.all.length && this.all[0].t < t - this.keep) this.all.shift();
  }

  /** Where it was at `t`; linear between samples, `null` before the first. */
  at(t) {
    const { all } = this;
    if (!all.length || t < all[0].t) return null;
    let low = 0;
    let high = all.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (all[middle].t <= t) low = middle;
      else high = middle - 1;
    }
    const [a, b] = [all[low], all[low + 1]];
    if (!b) return a.p;
    return add(a.p, scale([b.p[0] - a.p[0], b.p[1] - a.p[1], b.p[2] - a.p[2]], (t - a.t) / (b.t - a.t)));
  }

  since(t) {
    return this.all.filter((sample) => sample.t >= t);
  }

  clear() {
    this.all = [];
  }
}

/** How far `tip` is behind `hand`, ms: the shift at which the two paths lie closest; `null` for a hand that hardly moved. */
export function behind(hand, tip) {
  const seen = tip.since((tip.all.at(-1)?.t ?? 0) - 2000);
  const way = seen.reduce((sum, s, i) => sum + (i ? norm([0, 1, 2].map((k) => s.p[k] - seen[i - 1].p[k])) : 0), 0);
  if (seen.length < 12 || way < 0.08) return null;
  const miss = (shift) => {
    let [sum, count] = [0, 0];
    for (const { t, p } of seen) {
      const at = hand.at(t - shift);
      if (!at) continue;
      sum += (p[0] - at[0]) ** 2 + (p[1] - at[1]) ** 2 + (p[2] - at[2]) ** 2;
      count += 1;
    }
    return count > seen.length / 2 ? sum / count : Infinity;
  };
  let best = [Infinity, null];
  for (let shift = -100; shift <= 700; shift += 10) {
    const off = miss(shift);
    if (off < best[0]) best = [off, shift];
  }
  return best[1];
}
