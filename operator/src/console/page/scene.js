// What is seen: floor, arm, hand, ghost, tube, checkpoints, targets.

import { capsules, frames } from "./arm.js";
import { add, along, mix, rotate, scale } from "./math.js";
import { LINE, Renderer, SHADOW } from "./render.js";

const LIGHT = {
  ground: [0.933, 0.945, 0.957], grid: [0.72, 0.76, 0.8, 0.8], shadow: [0.83, 0.85, 0.875, 1],
  link: [0.96, 0.965, 0.97, 1], joint: [0.1, 0.47, 0.45, 1], tip: [0.13, 0.16, 0.2, 1],
  hand: [0.13, 0.37, 0.87, 1], ghost: [0.45, 0.5, 0.56, 0.55], tube: [0.05, 0.56, 0.52, 0.09], path: [0.05, 0.56, 0.52, 0.9],
  knot: [0.85, 0.52, 0.02, 1], trail: [0.13, 0.37, 0.87, 0.25], target: [0.8, 0.13, 0.2, 0.85], other: [0.5, 0.55, 0.6, 0.5],
};
const DARK = {
  ground: [0.071, 0.086, 0.106], grid: [0.3, 0.36, 0.42, 0.7], shadow: [0.04, 0.05, 0.062, 1],
  link: [0.72, 0.75, 0.79, 1], joint: [0.16, 0.62, 0.58, 1], tip: [0.86, 0.9, 0.94, 1],
  hand: [0.36, 0.6, 1, 1], ghost: [0.62, 0.68, 0.74, 0.5], tube: [0.24, 0.8, 0.74, 0.09], path: [0.3, 0.85, 0.78, 0.9],
  knot: [1, 0.76, 0.28, 1], trail: [0.36, 0.6, 1, 0.25], target: [1, 0.35, 0.38, 0.85], other: [0.5, 0.56, 0.62, 0.5],
};

export class Scene {
  constructor(canvas, view) {
    this.canvas = canvas;
    this.view = view;
    this.renderer = new Renderer(canvas);
    this.quality = 1;
    Object.assign(this, { pace: 16, asked: performance.now(), next: 0 });
    const dark = matchMedia("(prefers-color-scheme: dark)");
    const choose = () => (this.colours = dark.matches ? DARK : LIGHT);
    dark.addEventListener("change", choose);
    choose();
  }

  fit() {
    const ratio = Math.min(2, devicePixelRatio || 1) * this.quality;
    const { clientWidth, clientHeight } = this.canvas;
    const [width, height] = [Math.round(clientWidth * ratio), Math.round(clientHeight * ratio)];
    if (this.canvas.width !== width || this.canvas.height !== height) {
      [this.canvas.width, this.canvas.height] = [width, height];
      this.view.resize(clientWidth, clientHeight);
    }
  }

  /**
   * Whether to draw at `time`, ms. A machine that cannot keep up gets a coarser picture and fewer of them: what holds the
   * clutch runs beside the drawing, and has half of the time.
   */
  due(time) {
    if (time < this.next) return false;
    // The frame after one that was drawn says how long that took.
    const took = Math.min(200, time - this.asked);
    this.pace += 0.1 * (took - this.pace);
    if (this.pace > 45 && this.quality > 0.35) [this.quality, this.pace] = [this.quality * 0.7, 16];
    this.next = took > 34 ? time + took : 0;
    this.asked = this.next || time;
    return true;
  }

  /** Whether a picture of `what` (numbers, however nested) differs from the last that was asked about, as far as an eye can see. */
  differs(what) {
    const { clientWidth, clientHeight } = this.canvas;
    const seen = JSON.stringify([what, this.view.eye, clientWidth, clientHeight, this.quality, this.colours === DARK],
      (_, v) => (typeof v === "number" ? Math.round(v * 5000) : v));
    if (seen === this.seen) return false;
    this.seen = seen;
    return true;
  }

  /** `what`: arm, q, hand, ghost, trail, path, knots, targets; whatever is missing is not drawn. */
  draw(what) {
    this.fit();
    this.floor();
    if (what.arm && what.q) this.arm(what.arm, what.q);
    if (what.hand) this.hand(what.hand, what.held);
    if (what.ghost) this.renderer.add("clear", what.ghost, what.ghost, 0.017, this.colours.ghost);
    this.line("clear", what.trail ?? [], 0.0025, this.colours.trail);
    this.tube(what.path ?? []);
    for (const [x, y, z, known] of what.knots ?? []) {
      const p = [x, y, z];
      this.renderer.add("solid", p, p, known ? 0.0065 : 0.0045, this.colours.knot);
    }
    if (what.targets) this.targets(what.targets);
    this.renderer.draw(this.view, this.colours.ground);
  }

  floor() {
    for (let i = -12; i <= 12; i++) {
      const s = i * 0.1;
      const r = i % 5 === 0 ? 0.0016 : 0.0008;
      this.renderer.add("floor", [0.2 + s, -1.2, 0], [0.2 + s, 1.2, 0], r, this.colours.grid, LINE);
      this.renderer.add("floor", [-1, s, 0], [1.4, s, 0], r, this.colours.grid, LINE);
    }
  }

  arm(arm, q) {
    const posed = frames(arm, q);
    for (const { a, b, r } of capsules(arm, posed)) {
      this.renderer.add("floor", a, b, r, this.colours.shadow, SHADOW);
      this.renderer.add("solid", a, b, r, this.colours.link);
    }
    // Every joint as a drum about its axis.
    arm.joints.forEach((joint, i) => {
      const at = posed.links[i + 1];
      const axis = rotate(at.q, joint.axis);
      const r = drum(arm, i + 1);
      this.renderer.add("solid", along(at.p, axis, -r * 0.7), along(at.p, axis, r * 0.7), r, this.colours.joint);
    });
    const { tip } = posed;
    this.renderer.add("solid", tip.p, tip.p, 0.009, this.colours.tip);
  }

  hand(p, held) {
    const floor = [p[0], p[1], 0.001];
    this.renderer.add("floor", p, p, 0.02, this.colours.shadow, SHADOW);
    this.renderer.add("clear", p, floor, 0.0012, this.colours.trail);
    this.renderer.add("solid", p, p, held ? 0.014 : 0.018, this.colours.hand);
    // In front of whatever carries it: it is there to be taken hold of.
    const before = mix(p, this.view.eye, 0.07);
    this.ring(before, this.view.right, this.view.up, held ? 0.03 : 0.024, 0.002, this.colours.hand, "solid");
  }

  tube(path) {
    for (let i = 1; i < path.length; i++) {
      const [a, b] = [path[i - 1], path[i]];
      const sigma = Math.min(0.12, Math.max(0.004, b[3]));
      this.renderer.add("clear", a.slice(0, 3), b.slice(0, 3), sigma, this.colours.tube);
    }
    this.line("clear", path.map((p) => p.slice(0, 3)), 0.0028, this.colours.path);
  }

  line(layer, points, r, colour) {
    for (let i = 1; i < points.length; i++) this.renderer.add(layer, points[i - 1], points[i], r, colour);
  }

  ring(p, x, y, radius, r, colour, layer) {
    const at = (i) => {
      const angle = (i / 32) * 2 * Math.PI;
      return add(p, add(scale(x, radius * Math.cos(angle)), scale(y, radius * Math.sin(angle))));
    };
    for (let i = 0; i < 32; i++) this.renderer.add(layer, at(i), at(i + 1), r, colour);
  }

  targets({ places, width, lit, x, y }) {
    places.forEach((p, i) => {
      const now = i === lit;
      this.ring(p, x, y, width / 2, now ? 0.003 : 0.0012, now ? this.colours.target : this.colours.other, "solid");
    });
  }
}

function drum(arm, link) {
  const own = arm.capsules.filter((c) => c.link === link || c.link === link - 1).map((c) => c.radius_m);
  return Math.max(0.012, Math.min(...(own.length ? own : [0.04])) * 0.88);
}
