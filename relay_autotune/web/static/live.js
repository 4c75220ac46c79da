// Copyright 2026 the developers of relay_autotune
// SPDX-License-Identifier: Apache-2.0

// The loop as it runs: samples as they come, what the tune does in words, and what can be wished.

import { $, Plot, button, put } from "./plot.js";

// More points than this are not kept, some for each pixel of a figure.
const MOST = 2000;
// What stands for a loop at which nothing is done, by how the last thing went.
const IDLE = { "": "ready", good: "ready", warn: "ready", bad: "not done" };
const TONES = { settling: "warn", kick: "warn", relay: "warn", completed: "good", aborted: "bad", failed: "bad" };

export function table(host, rows, cells) {
  host.replaceChildren();
  const body = host.tagName === "TBODY" ? host : put(host, "tbody");
  for (const row of rows) {
    const line = put(body, "tr");
    row.forEach((text, k) => {
      const cell = put(line, k === 0 ? "th" : "td", text, cells[k]);
      if (k === 0) cell.scope = "row";
    });
  }
}

// The samples of a signal. Where there are too many, every second one of the older half is dropped.
// The memory is taken once: a page that is open for hours needs no more.
class Signal {
  constructor() {
    this.times = new Float64Array(MOST);
    this.values = new Float64Array(MOST);
    this.clear();
  }

  clear() { this.count = 0; }

  push(time, value) {
    if (this.count === MOST) {
      this.count = 0;
      for (let k = 0; k < MOST; k += k < MOST / 2 ? 2 : 1) this.push(this.times[k], this.values[k]);
    }
    this.times[this.count] = time;
    this.values[this.count] = value;
    this.count += 1;
  }

  get first() { return this.times[0]; }

  get last() { return this.times[this.count - 1]; }

  get now() { return this.values[this.count - 1]; }

  get curve() { return { x: this.times.subarray(0, this.count), y: this.values.subarray(0, this.count) }; }
}

// Time that is shown while no tune has run [s].
const LAST = 60;

const curve = ([x, y], kind, name) => ({ x, y, kind, name });

// The values of a signal within a time; the one before it holds at its beginning.
function within(signal, [from, to]) {
  const found = [];
  for (let k = 0; k < signal.count; k += 1) {
    if (signal.times[k] >= from && signal.times[k] <= to) found.push(signal.values[k]);
  }
  return found;
}

// The range of a figure: all values, the lines, and a limit where it is not far away.
function reach(values, limits, lines) {
  const all = [...values, ...lines];
  if (!all.length) return undefined;
  let low = Math.min(...all), high = Math.max(...all);
  const span = high - low || Math.abs(high) || 1;
  for (const limit of limits) {
    if (limit > low - 2 * span && limit < high + 2 * span) { low = Math.min(low, limit); high = Math.max(high, limit); }
  }
  const room = 0.06 * (high - low) || 0.05 * Math.abs(high) || 0.5;
  return [low - room, high + room];
}

// What is known of one loop.
class Loop {
  constructor(number) {
    this.number = number;
    this.snapshot = null;
    this.shown = {};
    this.signals = { measurement: new Signal(), command: new Signal() };
  }

  get phase() { return this.snapshot ? this.snapshot.phase : ""; }

  get running() { return this.phase === "tuning" || this.phase === "verifying"; }

  take(message) {
    Object.assign(this.shown, message.shown);
    for (const [name, [times, values]] of Object.entries(message.samples || {})) {
      const signal = this.signals[name];
      if (message.all) signal.clear();
      for (let k = 0; k < times.length; k += 1) {
        // A command holds until the next one.
        const steps = name === "command" && !message.all && signal.count && signal.now !== values[k];
        if (steps) signal.push(times[k], signal.now);
        signal.push(times[k], values[k]);
      }
    }
  }
}

export class Live {
  // wish: sends a wish; plan: the dialog; offered: returns the gains that the page shows, as
  // {wish, words, doubtful}; null: it shows none; chosen: called when another loop is shown
  constructor(wish, plan, offered, chosen) {
    this.wish = wish;
    this.plan = plan;
    this.question = 0; // number of what the plan waits for; 0: nothing
    this.offered = offered;
    this.chosen = chosen;
    this.loops = [];
    this.loop = null; // the one that is shown
    this.drawn = false; // just now
    this.stale = false; // samples came since it was drawn
    this.plots = {
      measurement: new Plot($("plot-live-measurement"), { label: "Measurement as it comes", y: "measurement [y]" }),
      command: new Plot($("plot-live-command"), { label: "Command as it comes", x: "time [s]", y: "command [u]" }),
    };
    $("start").addEventListener("click", () => this.begin("start", `Tune ${this.snapshot.node}`, "Start the tune"));
    $("abort").addEventListener("click", () => this.send("abort"));
    this.model = new Plot($("plot-so-far"), { label: "Measurement so far, and the model", x: "time [s]", y: "measurement [y]" });
    this.ultimate = new Plot($("plot-ku"), { label: "K_u after each cycle with its 95 % interval", x: "cycles", y: "K_u [u/y]" });
    this.proof = new Plot($("plot-proof"), { label: "Verification: measured and predicted", x: "time [s]", y: "measurement [y]" });
    $("prove").addEventListener("click", () => {
      const words = this.snapshot.controller ? "Apply and verify" : "Prove the gains";
      this.begin("prove", words, words);
    });
    $("apply").addEventListener("click", () => this.begin("apply", "Apply without a step", "Apply"));
    $("verify").addEventListener("click", () => this.begin("verify", "Verify the gains in force", "Verify"));
    $("revert").addEventListener("click", () => this.begin("revert", "Return to the earlier gains", "Return to them"));
    document.addEventListener("visibilitychange", () => this.drawSoon());
  }

  get snapshot() { return this.loop.snapshot; }

  get signals() { return this.loop.signals; }

  send(what, more, loop = this.loop) {
    // What comes of it is said at the top.
    window.scrollTo(0, 0);
    this.wish(what, { loop: loop.number, ...more });
  }

  // message: {loop: its number, live: what is known, shown: figures, samples: the newest,
  //           all: they replace those before}
  take(message) {
    const loop = this.loops[message.loop] ||= new Loop(message.loop);
    this.loop ||= loop;
    loop.take(message);
    if (message.live) {
      const before = loop.snapshot;
      loop.snapshot = message.live;
      this.showLoops();
      // A plan must not stand before what ends a tune.
      if (loop.running && !(before && before.phase === loop.phase)) this.plan.close();
      if (loop === this.loop) this.show();
    }
    if (loop !== this.loop) return;
    const { proof, model } = message.shown || {};
    if (proof) this.showProof(proof);
    if (model !== undefined) this.showModel(model);
    if (message.samples) this.drawSoon();
  }

  // Nobody sees a page that is hidden; it is drawn when it is shown again.
  drawSoon() {
    this.stale = true;
    if (this.drawn || document.hidden) return;
    this.drawn = true;
    // Not by frames, which a window behind others never gets.
    setTimeout(() => {
      const begun = performance.now();
      this.stale = false;
      this.draw();
      // A slow machine, which may be the one that tunes, draws less often.
      setTimeout(() => {
        this.drawn = false;
        if (this.stale) this.drawSoon();
      }, Math.max(30, 4 * (performance.now() - begun)));
    }, 0);
  }

  // Show another loop.
  choose(loop) {
    this.loop = loop;
    $("live-cycles").replaceChildren();
    this.showLoops();
    this.show();
    this.showModel(loop.shown.model);
    this.showProof(loop.shown.proof || []);
    this.draw();
    this.chosen();
  }

  // A tab for each of several loops, and an end for each that runs, whichever is shown.
  showLoops() {
    const host = $("loops");
    host.hidden = this.loops.length < 2;
    const words = JSON.stringify([this.loop.number, this.loops.map((each) => [each.snapshot && each.snapshot.node, each.phase])]);
    if (host.hidden || this.words === words) return;
    this.words = words;
    host.replaceChildren();
    for (const loop of this.loops.filter((each) => each && each.snapshot)) {
      const tab = button(host, `${loop.snapshot.node}: ${loop.phase}`, () => this.choose(loop));
      tab.setAttribute("aria-pressed", String(loop === this.loop));
      if (loop.running && loop !== this.loop) {
        button(host, `Abort ${loop.snapshot.node}`, () => this.send("abort", {}, loop)).className = "stop";
      }
    }
  }

  draw() {
    const { measurement, command } = this.signals;
    const known = [measurement, command].filter((each) => each.count);
    if (!known.length) return;
    const last = Math.max(...known.map((each) => each.last));
    const { setpoint, hysteresis, limits = [], levels = [], window: tuned = [] } = this.snapshot || {};
    const [from, to] = tuned;
    // The last tune with a little before it, else the last minute.
    const first = Math.min(...known.map((each) => each.first));
    const end = to || last;
    const begin = from === undefined ? last - LAST : from - 0.05 * (end - from);
    const xs = [Math.max(first, begin), end];
    const lines = [];
    if (setpoint !== null && setpoint !== undefined) {
      lines.push({ y: setpoint, kind: "setpoint" });
      if (hysteresis > 0) lines.push({ y: setpoint + hysteresis, kind: "band-edge" }, { y: setpoint - hysteresis, kind: "band-edge" });
    }
    const held = command.count ? command.now : null;
    const said = (signal, unit) => `now ${signal.count ? signal.now.toPrecision(4) : "none"} ${unit}`;
    const ys = reach(within(measurement, xs), limits, lines.map((line) => line.y));
    const bounds = limits.filter((y) => ys && y >= ys[0] && y <= ys[1]);
    // The figure of the command, with the axis of time, is not there before the first command.
    const alone = $("plot-live-command").hidden = !command.count && !levels.length;
    this.plots.measurement.words.x = alone ? "time [s]" : "";
    this.plots.measurement.draw({
      xs, ys, said: said(measurement, "y"),
      curves: [{ ...measurement.curve, kind: "measured", name: "measurement" }],
      lines: [...lines, ...bounds.map((y) => ({ y, kind: "bound" }))],
      names: [["bound", bounds.length ? "limits of the tune" : ""], ["setpoint", lines.length ? "set-point, with the relay's band" : ""]],
    });
    this.plots.command.draw({
      xs, ys: reach(within(command, xs), [], held === null ? levels : [...levels, held]), said: said(command, "u"),
      curves: [{ ...command.curve, kind: "input", name: "command" }],
      lines: levels.map((y) => ({ y, kind: "level" })),
      names: [["level", levels.length ? "the relay's two levels" : ""]],
    });
    document.body.dataset.measured = measurement.count ? measurement.last : "";
  }

  show() {
    const snapshot = this.snapshot;
    $("live").hidden = false;
    $("live-bar").hidden = !this.loop.running;
    const tuning = snapshot.phase === "tuning";
    const state = tuning ? snapshot.state || "asked" : snapshot.phase === "idle" ? IDLE[snapshot.tone] : snapshot.phase;
    if ($("live-state").textContent !== state) $("live-state").textContent = state;
    $("live-state").className = `chip ${snapshot.tone || TONES[snapshot.state] || ""}`;
    $("live-status").textContent = snapshot.status;
    $("abort").disabled = !this.loop.running;
    $("abort").textContent = snapshot.phase === "verifying" ? "End the verification" : "Abort the tune";
    $("start").disabled = snapshot.phase !== "idle";
    $("start").parentElement.hidden = this.loop.running;
    $("abort").hidden = !this.loop.running;
    $("progress").hidden = !tuning;
    $("progress").value = snapshot.progress || 0;
    const left = snapshot.remaining > 0 ? `, about ${snapshot.remaining.toFixed(0)} s left` : "";
    $("live-times").textContent = tuning ? `${snapshot.elapsed.toFixed(0)} s so far${left}` : "";
    const cycles = $("live-cycles");
    if (cycles.children.length !== snapshot.cycles.length) {
      cycles.replaceChildren();
      for (const line of snapshot.cycles) put(cycles, "li", line);
    }
    $("live-process").textContent = snapshot.process;
    this.showPlan();
    $("result-box").hidden = !snapshot.result.length;
    $("live-result").textContent = snapshot.result.join("\n");
    document.body.dataset.phase = snapshot.phase;
    const runs = Boolean(snapshot.controller);
    $("force").hidden = tuning || !(runs || snapshot.proves);
    $("force-title").textContent = runs ? "The running controller" : "Prove the gains";
    for (const id of ["apply", "verify", "revert"]) $(id).hidden = !runs;
    $("prove").textContent = runs ? "Apply and verify" : "Prove with a step";
    table($("force-proof"), snapshot.proof, ["", "text"]);
    // The figure of a proof goes with its words: other gains have come since.
    $("proof").hidden = !(snapshot.proof.length && (this.loop.shown.proof || []).length);
    this.showForce();
  }

  // The gains of the page beside those of the running controller, and what may be done.
  showForce() {
    if (!(this.loop && this.snapshot && (this.snapshot.controller || this.snapshot.proves))) return;
    const { controller, present, phase } = this.snapshot;
    const new_ = this.offered();
    $("force-now").textContent = controller ? `${controller} has ${present}` : "Nobody else controls this loop: a controller of this command makes one step, and ends.";
    $("force-new").textContent = new_ ? `${controller ? "To apply" : "To prove"}: ${new_.words}${new_.doubtful ? ", which are doubtful" : ""}.` : "The page shows no gains that could be applied.";
    $("prove").disabled = $("apply").disabled = !(phase === "idle" && new_);
    $("verify").disabled = $("revert").disabled = phase !== "idle";
  }

  // The newest model of the running tune; null: there is none yet.
  showModel(model) {
    $("so-far").hidden = !model;
    table($("live-estimates"), model ? model.estimates : [], ["", "", "unit", "interval"]);
    if (!model) return;
    const [data, drawn] = model.data || [[[], []], [[], []]];
    this.model.draw({ curves: [curve(data, "measured", "measurement"), curve(drawn, "model", "model")] });
    const { cycle, value, low, high } = model.gains;
    const sure = low.map((each, k) => k).filter((k) => low[k] !== null);
    const of = (values) => sure.map((k) => values[k]);
    // One value is in the table already.
    $("plot-ku").hidden = cycle.length < 2;
    this.ultimate.draw({
      marks: cycle.map((x, k) => ({ x, y: value[k], kind: "point", name: "" })),
      bands: [{ x: of(cycle), low: of(low), high: of(high), name: "95 % interval" }],
      curves: [curve([cycle, value], "model", "K_u")],
      said: `now ${value[value.length - 1]}`,
    });
  }

  showProof(steps) {
    $("proof").hidden = !(this.snapshot.proof.length && steps.length);
    if (!steps.length) return;
    const [step] = steps;
    this.proof.draw({
      curves: [curve(step.measurement, "measured", "measured"), curve(step.predicted, "model", "predicted")],
      said: step.name,
    });
  }

  // Have the server say what a wish would do, and send it once that is agreed to.
  begin(what, title, yes) {
    const { loop } = this;
    const gains = what === "prove" || what === "apply" ? this.offered() : null;
    const doubtful = Boolean(gains && gains.doubtful);
    const words = (typed) => ({ ...(gains && gains.wish), accept_doubtful: doubtful, ...(what === "start" ? { settings: typed } : typed) });
    this.question = 0;
    this.plan.begin(title, yes + (doubtful ? ", though they are doubtful" : ""), (typed) => this.send(what, words(typed), loop), (typed) => {
      this.question = 1 + Math.floor(Math.random() * 2 ** 52);
      this.seen = this.snapshot.plan.number;
      // What is looked at now is of other answers, or of another page.
      this.again = this.snapshot.phase !== "idle";
      if (!this.again) this.wish(what, { loop: loop.number, ...words(typed), dry: this.question });
    });
  }

  showPlan() {
    const { phase, plan } = this.snapshot;
    if (!this.plan.open || phase !== "idle" || !this.question) return;
    if (plan.number === this.question) {
      this.question = 0;
      this.plan.show(plan);
    } else if (this.again || plan.number !== this.seen) this.plan.ask();
  }
}
