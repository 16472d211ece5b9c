// Everything together, once a frame.

import { Smooth, frames } from "./arm.js";
import { Drive, History, behind } from "./drive.js";
import { Fitts } from "./fitts.js";
import { Link } from "./link.js";
import { Panel } from "./panel.js";
import { Plots } from "./plots.js";
import { Scene } from "./scene.js";
import { View } from "./view.js";

const $ = (id) => document.getElementById(id);
const canvas = $("scene");
const link = new Link();
const view = new View();
const smooth = new Smooth();
const hand = new History();
const tip = new History();
let shown = null;

const tipShown = () => (shown && link.arm ? frames(link.arm, shown.q).tip.p : shown?.tip ?? null);
const drive = new Drive(link, view, canvas, tipShown);
const fitts = new Fitts(link, view);
const panel = new Panel(link, drive, fitts);
const plots = new Plots($("plots"));
let scene = null;

function see() {
  try {
    scene = new Scene(canvas, view);
  } catch (error) {
    return blind(error.message);
  }
  shows(true);
}

/** Nobody takes hold of what is not seen; the keys and the buttons remain. */
function blind(why) {
  scene = null;
  drive.end();
  panel.log(`no picture: ${why}`);
  shows(false);
}

function shows(seen) {
  drive.blind = !seen;
  $("plain").hidden = seen;
  $("stage").classList.toggle("blind", !seen);
}

see();
canvas.addEventListener("webglcontextlost", (event) => {
  // Or it would never be given back.
  event.preventDefault();
  blind("the browser took the graphics away");
});
canvas.addEventListener("webglcontextrestored", see);

let [measured, before, last] = [{}, null, null];

link.addEventListener("now", ({ detail: now }) => {
  if (now.arm) {
    const fresh = now.arm.t !== last;
    last = now.arm.t;
    smooth.take(now.arm.t, now.arm.q, now.arm.tip);
    tip.take(now.arm.t, now.arm.tip);
    if (fresh) fitts.take(now);
  }
  if (now.hand) hand.take(now.hand.t, now.hand.p);
  else hand.clear();
  measure(now);
});

link.addEventListener("link", ({ detail: { open } }) => open || plots.silent());

/** Four times a second: rates, and how far the arm is behind the hand. */
function measure(now) {
  const { arm, sent, robot } = now;
  if (before && now.t < before.t) before = null;
  if (before && now.t - before.t < 250) return;
  const span = before ? (now.t - before.t) / 1000 : null;
  const rate = (value, was) => (span ? Math.max(0, value - was) / span : null);
  const following = robot?.state === "Engaged" && now.driving === "hand";
  const lag = following ? behind(hand, tip) : null;
  const unhidden = arm && robot ? arm.delay_ms + robot.lag_ms : null;
  measured = {
    age: following ? arm?.age_ms : null, delay: arm?.delay_ms, lag,
    hidden: lag === null ? null : unhidden - lag, clamps: arm?.clamps, lost: arm?.lost,
    // What was recognised last is no news once the hand is let go.
    seen: following ? now.seen : null, tip: arm?.tip,
  };
  panel.figures(measured);
  plots.take(now.t, {
    ...measured, state: now.linked ? robot?.state : null, bytes: rate(sent.bytes, before?.bytes), messages: rate(sent.messages, before?.messages),
    clamps: arm && before?.clamps <= arm.clamps ? rate(arm.clamps, before.clamps) : 0,
  });
  before = { t: now.t, clamps: arm?.clamps ?? 0, ...sent };
}

// Beside the picture: whether the clutch is held does not depend on how fast the screen is.
setInterval(() => drive.tick(performance.now()), 8);

function frame(time) {
  const { now } = link;
  shown = smooth.at(performance.now()) ?? null;
  const held = drive.what === "hand" || drive.what === "record";
  // What the daemon made of the hand lies where the arm is to be; the hand of this very frame is fresher.
  const offset = now?.offset ?? [0, 0, 0];
  // Whoever watches sees the hand of the page that drives, as the daemon has it.
  const watched = !drive.what && (now?.driving === "hand" || now?.driving === "record") ? now.hand?.p : null;
  const place = watched ?? (held && drive.p ? drive.p.map((v, i) => v + (drive.what === "record" ? 0 : offset[i])) : tipShown());
  const moves = held || watched != null;
  const drives = moves && now?.driving === "hand";
  const looks = [moves, now?.linked, link.arm?.joints.length, shown?.q, place, fitts.run?.gain, fitts.run?.at];
  if (scene?.due(time) && (scene.differs(looks) || moves)) {
    scene.draw({
      arm: link.arm, q: shown?.q, hand: now?.linked ? place : null, held: moves,
      ghost: drives && now.arm && now.hand ? hand.at(now.t - now.arm.delay_ms) : null,
      trail: moves ? hand.since((now?.hand?.t ?? 0) - 1200).map((s) => s.p) : [],
      path: now?.path, knots: now?.knots, targets: fitts.targets,
    });
  }
  $("stale").hidden = !link.arm || !scene || now?.linked === true;
  $("stage").classList.toggle("stale", now?.linked !== true);
  $("fitts-score").hidden = !fitts.run;
  $("fitts-score").textContent = fitts.count;
  plots.draw(time);
  requestAnimationFrame(frame);
}
requestAnimationFrame(frame);

// For whoever tests the page.
globalThis.telemime = { link, view, get scene() { return scene; }, drive, fitts, tip: tipShown, hand: () => hand.all.at(-1)?.p ?? null, measured: () => measured };
