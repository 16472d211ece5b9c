// Strips of the last seconds.

const SPAN_MS = 15_000;

export const PLOTS = [
  { key: "age", name: "Age", unit: "ms", floor: 100, second: "delay" },
  { key: "lag", name: "Arm behind hand", unit: "ms", floor: 200 },
  { key: "bytes", name: "To the robot", unit: "B/s", floor: 500 },
  { key: "messages", name: "Motion messages", unit: "/s", floor: 20 },
  { key: "clamps", name: "Ticks at a limit", unit: "/s", floor: 50 },
  { key: "state", name: "State", unit: "", states: true },
];

const STATES = { Engaged: "--engaged", Coasting: "--coasting", Holding: "--holding", Stopped: "--stop" };

export class Plots {
  constructor(root) {
    this.root = root;
    this.rows = [];
    this.slow = matchMedia("(prefers-reduced-motion: reduce)");
    this.drawn = 0;
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => (this.fresh = true));
    this.plots = PLOTS.map((plot) => {
      const figure = document.createElement("figure");
      const caption = document.createElement("figcaption");
      const name = document.createElement("span");
      const value = document.createElement("b");
      const canvas = document.createElement("canvas");
      name.textContent = plot.name;
      caption.append(name, value);
      canvas.setAttribute("role", "img");
      figure.append(caption, canvas);
      root.append(figure);
      return { ...plot, value, canvas };
    });
  }

  /** One row of values at `t`, ms; what is unknown is null. */
  take(t, row) {
    if (this.rows.length && t < this.rows.at(-1).t) this.rows = [];
    this.rows.push({ t, ...row });
    while (this.rows[0].t < t - SPAN_MS) this.rows.shift();
    this.fresh = true;
  }

  /** What was said last is not so any more. */
  silent() {
    for (const { value, canvas, name } of this.plots) {
      value.textContent = "–";
      canvas.setAttribute("aria-label", `${name}: unknown`);
    }
  }

  draw(now) {
    // Nothing scrolls for those who asked for rest: twice a second is enough to read.
    if (now - this.drawn < (this.slow.matches ? 500 : 100) || !this.fresh) return;
    this.drawn = now;
    this.fresh = false;
    const style = getComputedStyle(this.root);
    this.plots.forEach((plot) => this.strip(plot, style));
  }

  strip(plot, style) {
    const { canvas } = plot;
    const ratio = Math.min(2, devicePixelRatio || 1);
    const [w, h] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
    if (canvas.width !== Math.round(w) || canvas.height !== Math.round(h)) [canvas.width, canvas.height] = [Math.round(w), Math.round(h)];
    const pen = canvas.getContext("2d");
    const colour = (name) => style.getPropertyValue(name).trim();
    pen.clearRect(0, 0, w, h);
    pen.fillStyle = colour("--ground");
    pen.fillRect(0, 0, w, h);
    const end = this.rows.at(-1).t;
    const x = (t) => w * (1 - (end - t) / SPAN_MS);
    const last = this.rows.at(-1)[plot.key];
    if (plot.states) {
      this.rows.forEach((row, i) => {
        pen.fillStyle = colour(STATES[row.state] ?? "--line");
        const from = x(row.t);
        pen.fillRect(from, h * 0.3, x(this.rows[i + 1]?.t ?? end) - from + 1, h * 0.4);
      });
      plot.value.textContent = last ?? "";
      canvas.setAttribute("aria-label", `State: ${last ?? "unknown"}`);
      return;
    }
    const keys = plot.second ? [plot.second, plot.key] : [plot.key];
    const values = this.rows.flatMap((row) => keys.map((key) => row[key])).filter(Number.isFinite);
    const top = Math.max(plot.floor, ...values) * 1.1;
    const low = Math.min(0, ...values);
    const y = (v) => h - 1 - ((v - low) / (top - low)) * (h - 3);
    keys.forEach((key, i) => {
      pen.strokeStyle = colour(keys.length > 1 && i === 0 ? "--ghost" : "--tube");
      pen.lineWidth = 1.5 * ratio;
      pen.beginPath();
      let pause = true;
      for (const row of this.rows) {
        if (!Number.isFinite(row[key])) {
          pause = true;
          continue;
        }
        if (pause) pen.moveTo(x(row.t), y(row[key]));
        else pen.lineTo(x(row.t), y(row[key]));
        pause = false;
      }
      pen.stroke();
    });
    const text = Number.isFinite(last) ? `${Math.round(last)} ${plot.unit}` : "–";
    plot.value.textContent = text;
    canvas.setAttribute("aria-label", `${plot.name}: ${text}`);
  }
}
