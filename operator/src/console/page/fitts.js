// Multi-directional pointing after ISO 9241-411: targets on a circle, each opposite the one before.

import { add, along, dot, norm, scale, sub, unit } from "./math.js";

/** With fewer movements in a sequence their end points say nothing of a width. */
const FEWEST = 3;
const CIRCLE_M = 0.15;
const REST_MS = 300;
/** A hand that has been in the circle for so long has an arm that cannot follow. */
const HELD_BACK_MS = 2000;

/** The order of `count` targets, an odd number, on the circle: always across it. */
export function order(count) {
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

  /** Two sequences of `count` targets around `centre`, with prediction and without; which comes first alternates. */
  begin(centre, width, count) {
    const first = this.results.length % 4 < 2;
    const { right, up } = this.view;
    const places = Array.from({ length: count }, (_, i) => {
      const angle = (i / count) * 2 * Math.PI;
      return add(centre, add(scale(right, (CIRCLE_M / 2) * Math.sin(angle)), scale(up, (CIRCLE_M / 2) * Math.cos(angle))));
    });
    this.run = { places, width, x: right, y: up, out: this.view.forward, gains: first ? [1, 0] : [0, 1], before: this.link.now?.gain ?? 1 };
    this.sequence();
  }

  sequence() {
    const { run } = this;
    const gain = run.gains.shift();
    if (gain === undefined) {
      const bits = (on) => this.results.slice(-2).find((r) => r.gain === on).throughput.toFixed(2);
      this.finish(`Done: ${bits(1)} bit/s with prediction, ${bits(0)} without.`);
      return;
    }
    Object.assign(run, { gain, order: order(run.places.length), at: 0, from: null, broken: false, trials: [], lit_t: null, held_t: null, rest: [], delays: [] });
    this.link.say({ do: "predict", gain });
    this.tell(`Prediction ${gain ? "on" : "off"}: bring the tip into the lit circle.`);
  }

  cancel() {
    if (this.run) this.finish("Cancelled.");
  }

  finish(text) {
    this.link.say({ do: "predict", gain: this.run.before });
    this.run = null;
    this.tell(text);
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

  /** A snapshot with a new report of the arm. */
  take({ t: now, arm: { t, tip, delay_ms }, hand, robot, you, gain }) {
    const { run } = this;
    if (!run) return;
    if (robot?.state !== "Engaged" || you !== true || gain !== run.gain) {
      // A movement that was interrupted is none: what is left of it says nothing.
      run.broken = true;
      run.lit_t = run.held_t = null;
      run.rest = [];
      return;
    }
    run.lit_t ??= now;
    run.delays.push(delay_ms);
    const target = run.places[run.order[run.at]];
    // Depth is not asked for: the circle lies in the picture's plane.
    const within = (p) => {
      const off = sub(p, target);
      const flat = along(off, run.out, -dot(off, run.out));
      return norm(flat) <= run.width / 2 ? flat : null;
    };
    const flat = within(tip);
    if (!flat) {
      run.rest = [];
      run.held_t = hand && within(hand.p) ? run.held_t ?? now : null;
      if (run.held_t !== null && now - run.held_t > HELD_BACK_MS) this.tell("A limit keeps the arm from this circle: cancel, bring the arm to the middle of its reach, and start there.");
      return;
    }
    run.held_t = null;
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
    if (run.trials.length < FEWEST) {
      run.gains.unshift(run.gain);
      this.sequence();
      this.tell("The clutch was let go too often for a result: this sequence once more.");
      return;
    }
    const delay_ms = run.delays.reduce((sum, v) => sum + v, 0) / run.delays.length;
    this.results.push({ gain: run.gain, targets: run.places.length, delay_ms, nominal: run.width, trials: run.trials, ...throughput(run.trials) });
    this.dispatchEvent(new Event("result"));
    this.sequence();
  }

  /** Every movement as a line. */
  csv() {
    const head = "sequence,prediction,circles,delay_ms,width_m,movement,distance_m,miss_m,time_s,effective_width_m,throughput_bit_s";
    const rows = this.results.flatMap((r, i) => r.trials.map((t, k) => {
      const way = sub(t.to, t.from);
      const miss = dot(sub(t.end, t.to), unit(way));
      return [i + 1, r.gain, r.targets, r.delay_ms.toFixed(1), r.nominal, k + 1, norm(way).toFixed(4), miss.toFixed(6), t.time_s.toFixed(3), r.width.toFixed(6), r.throughput.toFixed(3)].join(",");
    }));
    return [head, ...rows].join("\n") + "\n";
  }
}
