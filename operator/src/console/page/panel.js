// Everything beside the picture: state, figures, buttons, teaching, the link, the log.

const $ = (id) => document.getElementById(id);

/** How the robot's words are said to people. */
const CAUSES = {
  Requested: "", NewsArrived: "", NewsLate: "the link is late: following the prediction, slower and slower",
  LeaseExpired: "no news in time: stopped by itself. Press again to go on", PlanFinished: "played to its end",
  ConnectionLost: "the connection ended: it holds", OperatorStop: "stopped from here", LocalStop: "stopped at the robot: reset it there",
  ClockStep: "the clock jumped: press again", Fault: "the robot fell behind: press again",
  ArmFault: "what drives the arm failed: see the robot's log, then press again",
};

/** What the clutch is held for. */
const DOING = { hand: "following the hand", play: "playing a skill", record: "recording a stroke: the arm stays" };

export class Panel {
  constructor(link, drive, fitts) {
    Object.assign(this, { link, drive, fitts });
    this.noted = -1;
    this.choices = "";
    this.dragged = null;
    this.switched = 0;
    this.buttons();
    this.sliders();
    this.measuring();
    this.gone = false;
    // What stays in sight of a small screen stays below the header, however many lines that has.
    new ResizeObserver(([{ target }]) => document.body.style.setProperty("--head", `${target.offsetHeight}px`)).observe(document.querySelector("header"));
    link.addEventListener("link", (event) => this.onLink(event.detail));
    link.addEventListener("now", (event) => this.onNow(event.detail));
    drive.addEventListener("change", () => this.pressed());
    drive.addEventListener("owed", () => this.log("no connection to the operator: the emergency stop is said as soon as there is one"));
  }

  buttons() {
    const { link, drive } = this;
    drive.button($("hold"), () => drive.begin("hand"));
    drive.button($("play"), () => drive.begin("play", $("skills").value));
    // At once, wherever the finger goes then; a click that no pointer made is a key's or a screen reader's.
    $("stop").addEventListener("pointerdown", () => drive.stop());
    $("stop").addEventListener("click", (event) => event.detail === 0 && drive.stop());
    $("reset").addEventListener("click", () => link.say({ do: "reset", changes: link.now?.robot?.changes }));
    $("predict").addEventListener("change", (event) => {
      this.switched = performance.now();
      link.say({ do: "predict", gain: event.target.checked ? 1 : 0 });
    });
    $("record").addEventListener("change", (event) => {
      drive.end();
      drive.recording = event.target.checked;
      this.log(drive.recording ? "recording: drag the hand, the arm stays" : "recording off: the arm follows again");
    });
    $("discard").addEventListener("click", () => link.say({ do: "discard" }));
    $("learn").addEventListener("click", () => {
      drive.recording = $("record").checked = false;
      link.say({ do: "learn", name: $("name").value });
    });
    $("skills").addEventListener("change", (event) => event.target.value && link.say({ do: "use", skill: event.target.value }));
  }

  sliders() {
    const say = () => this.link.say({ do: "link", delay_ms: +$("delay").value, jitter_ms: +$("jitter").value, loss_percent: +$("loss").value });
    for (const id of ["delay", "jitter", "loss"]) {
      const slider = $(id);
      slider.addEventListener("input", () => {
        this.dragged = performance.now();
        this.label(slider);
        say();
      });
    }
  }

  label(slider) {
    const text = slider.id === "loss" ? `${slider.value} %` : `${slider.value} ms`;
    slider.parentElement.querySelector("output").textContent = text;
    slider.setAttribute("aria-valuetext", text);
  }

  measuring() {
    const { fitts, drive } = this;
    $("fitts-start").addEventListener("click", () => {
      if (fitts.run) return fitts.cancel();
      const tip = drive.tip();
      if (tip) fitts.begin(tip, +$("width").value, +$("circles").value);
    });
    $("fitts-csv").addEventListener("click", () => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([fitts.csv()], { type: "text/csv" }));
      link.download = "fitts.csv";
      link.click();
      // A browser may begin to read only after this event.
      setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
    });
    fitts.addEventListener("say", (event) => {
      $("fitts-say").textContent = event.detail;
      $("fitts-start").textContent = fitts.run ? "Cancel" : "Start";
    });
    fitts.addEventListener("result", () => {
      $("fitts-table").hidden = false;
      $("fitts-csv").disabled = false;
      const { gain, time_s, width, throughput } = fitts.results.at(-1);
      const row = $("fitts-table").tBodies[0].insertRow();
      for (const text of [gain ? "on" : "off", time_s.toFixed(2), (width * 1e3).toFixed(1), throughput.toFixed(2)]) row.insertCell().textContent = text;
    });
  }

  pressed() {
    const { what } = this.drive;
    $("hold").setAttribute("aria-pressed", String(what === "hand" || what === "record"));
    $("play").setAttribute("aria-pressed", String(what === "play"));
  }

  onLink({ open, why }) {
    if (open) {
      if (this.gone) this.log("connected again");
      this.gone = false;
      return;
    }
    // It calls again every second: that is no news.
    if (!this.gone) this.log(why ? `disconnected: ${why}` : "the operator daemon does not answer");
    this.gone = true;
    this.state("", why || "the operator daemon does not answer");
    this.show("state-name", "disconnected");
    $("hold").disabled = $("play").disabled = true;
    $("reset").hidden = true;
    this.figures({});
  }

  state(state, why) {
    $("state").dataset.state = state;
    this.show("state-name", state || "no robot");
    this.show("why", why);
  }

  /** Changes a text only if it does change: what is announced is not announced twice. */
  show(id, text) {
    if ($(id).textContent !== text) $(id).textContent = text;
  }

  onNow(now) {
    const { robot } = now;
    const state = now.linked ? robot?.state ?? "" : "";
    const doing = now.you === false ? `another page drives: ${DOING[now.driving]}` : DOING[now.driving];
    this.state(state, now.linked ? (CAUSES[robot?.cause] ?? robot?.cause) || (doing ?? "") : now.why);
    this.show("robot", robot ? robot.name : "no robot yet");
    $("reset").hidden = state !== "Stopped";
    $("hold").disabled = $("play").disabled = !state || state === "Stopped" || now.you === false;
    $("play").disabled ||= !now.skills.length;
    // What was just switched is not switched back by what was said before.
    if (performance.now() - this.switched > 500) $("predict").checked = now.gain > 0;
    $("predict").disabled = this.fitts.run !== null;
    this.teaching(now);
    this.shape(now.shape);
    for (const [id, text] of now.notes) {
      if (id > this.noted) {
        this.noted = id;
        this.log(text);
      }
    }
  }

  teaching({ strokes, learning, skills, using }) {
    const n = strokes.length;
    this.show("strokes", learning ? "learning…" : n ? `${n} stroke${n > 1 ? "s" : ""}, ${strokes.map((s) => s.toFixed(1)).join(" ")} s` : "no stroke yet");
    $("discard").disabled = !n || learning;
    $("learn").disabled = n < 2 || learning;
    const choices = JSON.stringify([skills, using]);
    if (choices === this.choices) return;
    this.choices = choices;
    $("skills").replaceChildren(...(skills.length ? skills : [""]).map((name) => new Option(name || "none yet", name, false, name === using)));
  }

  shape(shape) {
    $("link").hidden = !shape;
    if (!shape || (this.dragged && performance.now() - this.dragged < 1000)) return;
    for (const [id, value] of [["delay", shape.delay_ms], ["jitter", shape.jitter_ms], ["loss", shape.loss_percent]]) {
      $(id).value = value;
      this.label($(id));
    }
  }

  figures({ age, lag, hidden, clamps, seen, lost, tip }) {
    const ms = (value) => (Number.isFinite(value) ? `${Math.round(value)} ms` : "–");
    this.show("age", ms(age));
    this.show("lag", ms(lag));
    this.show("hidden", ms(hidden));
    this.show("clamps", clamps === undefined ? "–" : `${clamps}`);
    this.show("lost", lost === undefined ? "–" : `${lost}`);
    this.show("where", tip ? `${tip.map((v) => v.toFixed(2)).join(", ")} m (x, y, z)` : "–");
    this.show("skill", !seen ? "–" : seen.skill ? `${seen.skill} ${Math.round(seen.phase * 100)} %` : seen.what.toLowerCase());
  }

  log(text) {
    const line = document.createElement("li");
    const time = document.createElement("time");
    time.textContent = new Date().toLocaleTimeString([], { hour12: false });
    line.append(time, text);
    $("log").prepend(line);
    while ($("log").children.length > 60) $("log").lastChild.remove();
  }
}
