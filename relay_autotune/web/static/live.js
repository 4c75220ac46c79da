// Copyright 2026 the developers of relay_autotune
// SPDX-License-Identifier: Apache-2.0

// The loop as it runs: samples as they come, what the tune does in words, and what can be wished.

import { Plot } from "./plot.js";

const $ = (id) => document.getElementById(id);
// More points than this are not drawn; every second of the older ones is dropped then.
const MOST = 3000;
const TONES = { settling: "warn", kick: "warn", relay: "warn", completed: "good", aborted: "bad", failed: "bad" };

export function table(host, rows, cells) {
  const body = document.createElement("tbody");
  for (const row of rows) {
    const line = document.createElement("tr");
    row.forEach((text, k) => {
      const cell = document.createElement(k === 0 ? "th" : "td");
      cell.textContent = text;
      if (cells[k]) cell.className = cells[k];
      if (k === 0) cell.scope = "row";
      line.append(cell);
    });
    body.append(line);
  }
  host.replaceChildren(...(host.tagName === "TBODY" ? body.children : [body]));
}

function texts(host, name, lines) {
  if (host.children.length === lines.length) return;
  host.replaceChildren(...lines.map((line) => {
    const made = document.createElement(name);
    made.textContent = line;
    return made;
  }));
}

// What is known of one loop.
class Loop {
  constructor(number) {
    this.number = number;
    this.told = null;
    this.shown = {};
    this.asking = 0; // number of the check after which the start is to be confirmed; 0: none
    this.signals = { measurement: [[], []], command: [[], []] };
  }

  get phase() { return this.told ? this.told.phase : ""; }

  get running() { return this.phase === "tuning" || this.phase === "verifying"; }

  take(message) {
    Object.assign(this.shown, message.shown);
    for (const [name, [times, values]] of Object.entries(message.samples || {})) {
      const [t, v] = message.all ? [[], []] : this.signals[name];
      for (let k = 0; k < times.length; k += 1) {
        // A command holds until the next one.
        if (name === "command" && !message.all && v.length && v[v.length - 1] !== values[k]) {
          t.push(times[k]);
          v.push(v[v.length - 1]);
        }
        t.push(times[k]);
        v.push(values[k]);
      }
      this.signals[name] = t.length < MOST ? [t, v] : this.thinned(t, v);
    }
  }

  thinned(t, v) {
    const half = t.length >> 1;
    const keep = (_, k) => k >= half || k % 2 === 0;
    return [t.filter(keep), v.filter(keep)];
  }
}

export class Live {
  // wish: sends a wish; agreed: asks a question and resolves to the answer; offered: returns the
  // gains that the page shows, as {wish, words, doubtful}; null: it shows none; chosen: called
  // when another loop is shown
  constructor(wish, agreed, offered, chosen) {
    this.wish = wish;
    this.agreed = agreed;
    this.offered = offered;
    this.chosen = chosen;
    this.loops = [];
    this.loop = null; // the one that is shown
    this.drawn = false;
    const send = (what) => this.send(what);
    this.plots = {
      measurement: new Plot($("plot-live-measurement"), { label: "Measurement as it comes", y: "measurement [y]" }),
      command: new Plot($("plot-live-command"), { label: "Command as it comes", x: "time [s]", y: "command [u]" }),
    };
    $("check").addEventListener("click", () => send("check"));
    $("start").addEventListener("click", () => { this.loop.asking = this.told.checked + 1; send("check"); });
    $("abort").addEventListener("click", () => send("abort"));
    this.model = new Plot($("plot-so-far"), { label: "Measurement so far, and the model", x: "time [s]", y: "measurement [y]" });
    this.ultimate = new Plot($("plot-ku"), { label: "K_u after each cycle with its 95 % interval", x: "cycles", y: "K_u [u/y]" });
    this.proof = new Plot($("plot-proof"), { label: "Verification: measured and predicted", x: "time [s]", y: "measurement [y]" });
    $("apply").addEventListener("click", () => this.apply(Number($("step").value)));
    $("apply-only").addEventListener("click", () => this.apply(0));
    $("verify").addEventListener("click", () => this.verify(Number($("step").value)));
    $("revert").addEventListener("click", () => this.revert());
    $("step").addEventListener("input", () => this.showForce());
  }

  get told() { return this.loop.told; }

  get signals() { return this.loop.signals; }

  send(what, more, loop = this.loop) { this.wish(what, { loop: loop.number, ...more }); }

  // message: {loop: its number, live: what is known, shown: figures, samples: the newest,
  //           all: they replace those before}
  take(message) {
    const loop = this.loops[message.loop] ||= new Loop(message.loop);
    this.loop ||= loop;
    loop.take(message);
    if (message.live) {
      const before = loop.told;
      loop.told = message.live;
      this.showLoops();
      // A question must not stand before what ends a tune.
      if (loop.running && !(before && before.phase === loop.phase) && $("question").open) $("question-no").click();
      if (loop === this.loop) this.show(before);
      if (loop.asking && loop.told.checked >= loop.asking) {
        loop.asking = 0;
        if (loop.told.accepted) this.ask(loop);
      }
    }
    if (loop !== this.loop) return;
    const { proof, model } = message.shown || {};
    if (proof) this.showProof(proof);
    if (model !== undefined) this.showModel(model);
    if (this.drawn || !message.samples) return;
    this.drawn = true;
    // Not by frames, which a window behind others never gets.
    setTimeout(() => {
      const begun = performance.now();
      this.draw();
      // A slow machine, which may be the one that tunes, draws less often.
      setTimeout(() => { this.drawn = false; }, Math.max(30, 4 * (performance.now() - begun)));
    }, 0);
  }

  // Show another loop.
  choose(loop) {
    this.loop = loop;
    $("live-cycles").replaceChildren();
    this.showLoops();
    this.show(null);
    this.showModel(loop.shown.model);
    this.showProof(loop.shown.proof || []);
    this.draw();
    this.chosen();
  }

  // A tab for each of several loops, and an end for each that runs, whichever is shown.
  showLoops() {
    const host = $("loops");
    host.hidden = this.loops.length < 2;
    const words = JSON.stringify([this.loop.number, this.loops.map((each) => [each.told && each.told.node, each.phase])]);
    if (host.hidden || this.words === words) return;
    this.words = words;
    host.replaceChildren();
    const button = (text, work) => {
      const made = document.createElement("button");
      made.type = "button";
      made.textContent = text;
      made.addEventListener("click", work);
      host.append(made);
      return made;
    };
    for (const loop of this.loops.filter((each) => each && each.told)) {
      const tab = button(`${loop.told.node}: ${loop.phase}`, () => this.choose(loop));
      tab.setAttribute("aria-pressed", String(loop === this.loop));
      if (loop.running && loop !== this.loop) {
        button(`Abort ${loop.told.node}`, () => this.send("abort", {}, loop)).className = "stop";
      }
    }
  }

  draw() {
    const [t, y] = this.signals.measurement;
    const [tu, u] = this.signals.command;
    const ends = [t, tu].filter((each) => each.length);
    if (!ends.length) return;
    const xs = [Math.min(...ends.map((e) => e[0])), Math.max(...ends.map((e) => e[e.length - 1]))];
    const lines = [];
    const { setpoint, hysteresis } = this.told || {};
    if (setpoint !== null && setpoint !== undefined) {
      lines.push({ y: setpoint, kind: "setpoint" });
      if (hysteresis > 0) lines.push({ y: setpoint + hysteresis, kind: "band-edge" }, { y: setpoint - hysteresis, kind: "band-edge" });
    }
    const last = (values) => (values.length ? values[values.length - 1].toPrecision(4) : "none");
    this.plots.measurement.draw({ xs, curves: [{ x: t, y, kind: "measured", name: "measurement" }], lines, said: `now ${last(y)} y` });
    this.plots.command.draw({ xs, curves: [{ x: tu, y: u, kind: "command", name: "command" }], said: `now ${last(u)} u` });
    document.body.dataset.measured = t.length ? t[t.length - 1] : "";
  }

  show(before) {
    const told = this.told;
    $("live").hidden = false;
    $("live-bar").hidden = false;
    $("live-title").textContent = told.node;
    const tuning = told.phase === "tuning";
    const state = tuning ? told.state || "asked" : told.phase;
    if ($("live-state").textContent !== state) $("live-state").textContent = state;
    $("live-state").className = `chip ${told.tone || TONES[told.state] || ""}`;
    $("live-status").textContent = told.status;
    $("abort").disabled = !this.loop.running;
    $("abort").textContent = told.phase === "verifying" ? "End the verification" : "Abort the tune";
    $("check").disabled = $("start").disabled = told.phase !== "idle";
    $("progress").value = told.progress || 0;
    const left = told.remaining > 0 ? `, about ${told.remaining.toFixed(0)} s left` : "";
    $("live-times").textContent = tuning ? `${told.elapsed.toFixed(0)} s so far${left}` : "";
    if (before && before.cycles.length > told.cycles.length) $("live-cycles").replaceChildren();
    texts($("live-cycles"), "li", told.cycles);
    $("live-process").textContent = told.process;
    $("checks-box").hidden = !told.checks.length;
    if (!told.accepted && told.checks.length && !(before && before.checks.length)) $("checks-box").open = true;
    $("live-checks").textContent = told.checks.join("\n");
    $("result-box").hidden = !told.result.length;
    $("live-result").textContent = told.result.join("\n");
    document.body.dataset.phase = told.phase;
    $("force").hidden = !told.controller;
    if (told.step !== null && (!before || before.step !== told.step)) $("step").value = told.step;
    $("force-proof").hidden = !told.proof.length;
    $("force-proof").textContent = told.proof.join("\n");
    this.showForce();
  }

  // The gains of the page beside those of the running controller, and what may be done.
  showForce() {
    if (!(this.loop && this.told && this.told.controller)) return;
    const { controller, present, phase } = this.told;
    const new_ = this.offered();
    $("force-now").textContent = `${controller} has ${present}`;
    $("force-new").textContent = new_ ? `Applied would be ${new_.words}${new_.doubtful ? ", which are doubtful" : ""}.` : "The page shows no gains that could be applied.";
    const idle = phase === "idle";
    const step = Number($("step").value);
    const moves = Number.isFinite(step) && step !== 0;
    $("apply").disabled = !(idle && new_ && moves);
    $("apply-only").disabled = !(idle && new_);
    $("verify").disabled = !(idle && moves);
    $("revert").disabled = !idle;
  }

  // The newest model of the running tune; null: there is none yet.
  showModel(model) {
    $("so-far").hidden = !model;
    table($("live-estimates"), model ? model.estimates : [], ["", "", "unit", "interval"]);
    if (!model) return;
    const [data, drawn] = model.data || [[[], []], [[], []]];
    const curve = ([x, y], kind, name) => ({ x, y, kind, name });
    this.model.draw({ curves: [curve(data, "measured", "measurement"), curve(drawn, "model", "model")] });
    const { cycle, value, low, high } = model.gains;
    const sure = low.map((each, k) => k).filter((k) => low[k] !== null);
    const of = (values) => sure.map((k) => values[k]);
    this.ultimate.draw({
      bands: [{ x: of(cycle), low: of(low), high: of(high), name: "95 % interval" }],
      curves: [curve([cycle, value], "model", "K_u")],
      said: `now ${value[value.length - 1]}`,
    });
  }

  showProof(steps) {
    $("proof").hidden = !steps.length;
    if (!steps.length) return;
    const [step] = steps;
    const curve = ([x, y], kind, name) => ({ x, y, kind, name });
    this.proof.draw({
      curves: [curve(step.measurement, "measured", "measured"), curve(step.predicted, "model", "predicted")],
      said: `${step.name}, ${step.passed ? "as predicted" : "not as predicted"}`,
    });
  }

  stepWords(step) {
    return `Its set-point then steps by ${step} y and back, once the loop is at rest. If the loop does not do what the model predicts, the gains before come back by themselves.`;
  }

  async apply(step) {
    const new_ = this.offered();
    if (!new_) return;
    const { loop, told: { controller, present } } = this;
    if (new_.doubtful && !(await this.agreed(`These gains are doubtful: ${new_.doubtful}`, "Take them all the same"))) return;
    const then = step ? this.stepWords(step) : "They are not verified.";
    const what = `${controller} has ${present}. At once it gets ${new_.words}, without a bump of the command. ${then}`;
    if (await this.agreed(what, step ? "Apply and verify" : "Apply")) {
      this.send("apply", { ...new_.wish, step, accept_doubtful: Boolean(new_.doubtful) }, loop);
    }
  }

  async verify(step) {
    const { loop, told: { controller, present } } = this;
    if (await this.agreed(`${controller} keeps ${present}. ${this.stepWords(step)}`, "Verify")) this.send("verify", { step }, loop);
  }

  async revert() {
    const { loop, told: { controller, present } } = this;
    const what = `${controller} has ${present}. At once it gets the gains that it had before, without a bump of the command.`;
    if (await this.agreed(what, "Return to them")) this.send("revert", {}, loop);
  }

  async ask(loop) {
    const levels = loop.told.checks.find((line) => line.includes("levels")) || "";
    const what = `The relay will move the command of ${loop.told.node} until the tune has ended. ${levels.replace(/\s+/g, " ")}`;
    if (await this.agreed(what, "Start the tune")) this.send("start", {}, loop);
  }
}
