// Multi-directional pointing after ISO 9241-411: targets on a circle, each opposite the one before.

import { add, along, dot, norm, scale, sub, unit } from "./math.js";

const TARGETS = 9;
const CIRCLE_M = 0.15;
const REST_MS = 300;

/** The order of the targets on the circle: always across it. */
export function order(count = TARGETS) {
  return Array.from({ length: count + 1 }, (_, i) => (Math.floor(i / 2) + (i % 2 ? (count + 1) / 2 : 0)) % count);
}

/**
 * Throughput of one sequence. `trials`: `{ from, to, end, time_s }`, where the movement began and was to end, and where it
 * ended, m. The effective width is 4.133 standard deviations of the end points along the way, the effective distance the
 * mean of the ways made.
 */
export function throughput(trials) {
  const over = trials.map(({ from, to, end }) => {
    const way = sub(to, from);
    return { miss: dot(sub(end, to), unit(way)), way: norm(way) };
  });
  const mean = (values) => values.reduce((sum, v) => sum + v, 0) / values.length;
  const misses = over.map((o) => o.miss);
  const middle = mean(misses);
  const deviation = Math.sqrt(misses.reduce((sum, v) => sum + (v - middle) ** 2, 0) / Math.max(1, misses.length - 1));
  const width = 4.133 * deviation;
  const distance = mean(over.map((o) => o.way + o.miss));
  const time_s = mean(trials.map((t) => t.time_s));
  const bits = Math.log2(distance / Math.max(width, 1e-4) + 1);
  return { width, distance, time_s, bits, throughput: bits / time_s };
}

export class Fitts extends EventTarget {
  constructor(link, view) {
    super();
    Object.assign(this, { link, view });
    this.results = [];
    this.run = null;
  }

  /** Two sequences around `centre`, with prediction and without; which comes first alternates. */
  begin(centre, width) {
    const first = this.results.length % 4 < 2;
    const { right, up } = this.view;
    const places = Array.from({ length: TARGETS }, (_, i) => {
      const angle = (i / TARGETS) * 2 * Math.PI;
      return add(centre, add(scale(right, (CIRCLE_M / 2) * Math.sin(angle)), scale(up, (CIRCLE_M / 2) * Math.cos(angle))));
    });
    this.run = { places, width, x: right, y: up, out: this.view.forward, gains: first ? [1, 0] : [0, 1] };
    this.sequence();
  }

  sequence() {
    const { run } = this;
    const gain = run.gains.shift();
    if (gain === undefined) {
      this.run = null;
      this.link.say({ do: "predict", gain: 1 });
      this.tell("Done. The table and the CSV have the result.");
      return;
    }
    Object.assign(run, { gain, order: order(), at: 0, from: null, broken: false, trials: [], lit_t: null, rest: [], reports: [] });
    this.link.say({ do: "predict", gain });
    this.tell(`Prediction ${gain ? "on" : "off"}: bring the tip into the lit circle.`);
  }

  cancel() {
    if (!this.run) return;
    this.run = null;
    this.link.say({ do: "predict", gain: 1 });
    this.tell("Cancelled.");
  }

  tell(text) {
    this.dispatchEvent(new CustomEvent("say", { detail: text }));
  }

  get targets() {
    const { run } = this;
    return run && { places: run.places, width: run.width, lit: run.order[run.at], x: run.x, y: run.y };
  }

  get count() {
    const { run } = this;
    return run ? `${run.at} of ${run.order.length - 1}, prediction ${run.gain ? "on" : "off"}` : "";
  }

  /** A report of the arm: its tip at `t` ms, and `now` ms on the same clock. */
  take(t, tip, now, engaged) {
    const { run } = this;
    if (!run) return;
    if (!engaged) {
      // A movement that was interrupted is none: what is left of it says nothing.
      run.broken = true;
      run.lit_t = null;
      run.rest = [];
      return;
    }
    run.lit_t ??= now;
    const target = run.places[run.order[run.at]];
    // Depth is not asked for: the circle lies in the picture's plane.
    const off = sub(tip, target);
    const flat = along(off, run.out, -dot(off, run.out));
    if (norm(flat) > run.width / 2) {
      run.rest = [];
      return;
    }
    run.rest.push({ t, p: add(target, flat) });
    if (t - run.rest[0].t < REST_MS) return;
    this.reached(now);
  }

  reached(now) {
    const { run } = this;
    const [{ t }] = run.rest;
    const end = scale(run.rest.reduce((sum, r) => add(sum, r.p), [0, 0, 0]), 1 / run.rest.length);
    // The way to the first target began anywhere, and one after an interruption did: neither counts.
    const from = run.from;
    if (from && !run.broken) {
      run.trials.push({ from, to: run.places[run.order[run.at]], end, time_s: Math.max(0.001, (t - run.lit_t) / 1000) });
    }
    run.from = end;
    run.broken = false;
    run.at += 1;
    run.lit_t = now;
    run.rest = [];
    if (run.at < run.order.length) return;
    this.results.push({ gain: run.gain, nominal: run.width, trials: run.trials, ...throughput(run.trials) });
    this.dispatchEvent(new Event("result"));
    this.sequence();
  }

  /** Every movement as a line. */
  csv() {
    const head = "sequence,prediction,width_m,movement,distance_m,miss_m,time_s,effective_width_m,throughput_bit_s";
    const rows = this.results.flatMap((r, i) => r.trials.map((t, k) => {
      const way = sub(t.to, t.from);
      const miss = dot(sub(t.end, t.to), unit(way));
      return [i + 1, r.gain, r.nominal, k + 1, norm(way).toFixed(4), miss.toFixed(5), t.time_s.toFixed(3), r.width.toFixed(5), r.throughput.toFixed(3)].join(",");
    }));
    return [head, ...rows].join("\n") + "\n";
  }
}
