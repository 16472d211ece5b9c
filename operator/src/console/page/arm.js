// Forward kinematics of the chain the robot describes.

import { add, along, quatAbout, quatMul, rotate, mix } from "./math.js";

/** Frames of the base and of every link at joint values `q`, and the tip: `{ p, q }` each. */
export function frames(arm, q) {
  let at = { p: [0, 0, 0], q: [1, 0, 0, 0] };
  const links = [at];
  arm.joints.forEach((joint, i) => {
    at = step(at, joint.place);
    const value = q[i] ?? 0;
    at = joint.kind === "Prismatic"
      ? { p: along(at.p, rotate(at.q, joint.axis), value), q: at.q }
      : { p: at.p, q: quatMul(at.q, quatAbout(joint.axis, value)) };
    links.push(at);
  });
  return { links, tip: step(at, arm.tip) };
}

function step(at, place) {
  return { p: add(at.p, rotate(at.q, place.m)), q: quatMul(at.q, place.q) };
}

/** The arm's capsules in base axes: `{ a, b, r }`. */
export function capsules(arm, { links }) {
  return arm.capsules.map(({ link, from, to, radius_m }) => {
    const at = links[link];
    const place = (v) => add(at.p, rotate(at.q, v));
    return { a: place(from), b: place(to), r: radius_m };
  });
}

/** The arm between two reports, so that 20 reports a second look like motion. */
export class Smooth {
  constructor() {
    this.reports = [];
  }

  take(t, q, tip) {
    const last = this.reports.at(-1);
    if (last && t <= last.t) {
      // Another clock, or another session.
      if (t < last.t - 1000) this.reports = [];
      else return;
    }
    this.reports.push({ t, q, tip, seen: performance.now() });
    if (this.reports.length > 3) this.reports.shift();
  }

  /** Joint values and tip at `now`, one report late. */
  at(now) {
    const [a, b] = this.reports.slice(-2);
    if (!b) return a;
    const span = Math.min(200, Math.max(10, b.t - a.t));
    const u = Math.min(1, (now - b.seen) / span);
    return { q: b.q.map((v, i) => a.q[i] + (v - a.q[i]) * u), tip: mix(a.tip, b.tip, u) };
  }
}
