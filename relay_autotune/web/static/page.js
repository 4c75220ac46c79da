// Copyright 2026 the developers of relay_autotune
// SPDX-License-Identifier: Apache-2.0

// The page: it asks for gains as the controls say, and shows what is answered. All text from the
// server is set as text, never as markup.

import { Live, table } from "./live.js";
import { Plan } from "./plan.js";
import { $, Plot, button, put, units } from "./plot.js";

const pick = (rule) => { asked.rule = rule; showControls(); ask(); };
const plots = {
  measurement: new Plot($("plot-measurement"), { label: "Measurement after both steps", y: "measurement [y]" }),
  command: new Plot($("plot-command"), { label: "Command after both steps", x: "time [s]", y: "command [u]" }),
  nyquist: new Plot($("plot-nyquist"), { label: "Nyquist curve of the loop", x: "real part", y: "imaginary part" }),
  trade: new Plot($("plot-trade"), { label: "Robustness and speed of all rules", x: "Ms", y: "IAE after a load step [y s/u]", pick }),
  record: new Plot($("plot-record"), { label: "Measurement of the experiment, and the model", y: "measurement [y]" }),
  relay: new Plot($("plot-relay"), { label: "Command of the experiment", x: "time [s]", y: "command [u]" }),
};

let subjects = [];
let laws = [];
let keeps = ""; // the kinds of files that are offered
let chosen = -1; // number of the model that is shown
let asked = null; // what the controls say
let shaped = null; // what was answered last
const trades = []; // by model: kind, Ms and IAE of the controllers that are known
let socket = null;
let waiting = 0; // number of the question that has no answer yet; 0: none
let number = 0;
let changed = false; // the controls changed while an answer was awaited
let begun = 0;

// What is asked stands in the address, so that a page that is loaded again shows the same.
function remember() {
  const words = new URLSearchParams();
  if (subjects.length > 1) words.set("of", chosen);
  for (const [name, value] of Object.entries(asked)) if (value !== null) words.set(name, value);
  history.replaceState(null, "", `#${words}`);
}

function remembered(subject) {
  const words = new URLSearchParams(location.hash.slice(1));
  const found = { ...subject.first };
  for (const name of Object.keys(found)) {
    if (!words.has(name)) continue;
    const text = words.get(name);
    found[name] = ["rule", "controller", "law"].includes(name) ? text : Number(text);
  }
  const weight = found.setpoint_weight;
  const known = [subject.first.rule, ...subject.rules.map((each) => each.rule)];
  const fine = known.includes(found.rule) && (weight === null || (weight >= 0 && weight <= 1)) && found.ms >= 1.2 && found.ms <= 4 && ["auto", "pi", "pid"].includes(found.controller)
    && laws.includes(found.law) && found.sample_period >= 0 && found.noise_share >= 0;
  return fine ? found : { ...subject.first };
}

function ask() {
  const subject = subjects[chosen];
  remember();
  document.body.dataset.settled = "no";
  if (!subject.may_shape || !socket || socket.readyState !== WebSocket.OPEN) return;
  if (waiting) { changed = true; return; }
  number += 1;
  waiting = number;
  changed = false;
  begun = performance.now();
  socket.send(JSON.stringify({ of: chosen, n: number, asked }));
}

function showNoise() {
  const share = asked.noise_share;
  $("noise-value").textContent = `${(share * subjects[chosen].amplitude).toPrecision(2)} ${units.u || "u"}`;
  $("noise-part").textContent = `(${(100 * share).toFixed(0)} % of half its range in the test)`;
}

function showControls() {
  const subject = subjects[chosen];
  const [low, high, step] = subject.slider;
  const slider = $("ms");
  Object.assign(slider, { min: Math.min(low, asked.ms), max: Math.max(high, asked.ms), step });
  slider.value = asked.ms;
  $("ms-value").textContent = asked.ms.toFixed(2);
  for (const input of document.querySelectorAll("input[name=controller]")) {
    input.checked = input.value === asked.controller;
  }
  const rules = subject.rules.map((each) => each.rule);
  if (!rules.includes(asked.rule)) rules.unshift(asked.rule);
  $("rule").replaceChildren();
  for (const rule of rules) {
    const option = put($("rule"), "option", rule);
    option.value = rule;
    option.selected = rule === asked.rule;
  }
  const own = asked.setpoint_weight === null;
  $("own-weight").checked = own;
  $("weight").disabled = own;
  if (!own) $("weight").value = asked.setpoint_weight;
  $("noise").hidden = !subject.amplitude;
  Object.assign($("noise-share"), { max: Math.max(0.5, asked.noise_share) });
  $("noise-share").value = asked.noise_share;
  showNoise();
  $("law").replaceChildren();
  for (const law of laws) {
    const option = put($("law"), "option", law || "none in particular");
    option.value = law;
    option.selected = law === asked.law;
  }
  $("rate").value = asked.sample_period ? Number(asked.sample_period.toPrecision(6)) : "";
}

let saidChecks = "";

function showVerdict(verdict, checks) {
  const chip = $("verdict");
  if (chip.textContent !== verdict.text) chip.textContent = verdict.text;
  chip.className = `chip ${verdict.tone}`;
  const said = JSON.stringify(checks);
  if (said === saidChecks) return;
  saidChecks = said;
  $("checks").replaceChildren();
  $("failures").replaceChildren();
  const failed = checks.filter(([, tone]) => tone !== "good");
  const passed = `${checks.length - failed.length} of ${checks.length} checks passed`;
  const named = failed.map(([, , name]) => name.toLowerCase()).join(", ");
  $("marks").textContent = checks.length ? passed + (named ? `; not ${named}` : "") : "";
  $("marks").className = failed.some(([, tone]) => tone === "bad") ? "bad" : failed.length ? "warn" : "";
  $("checks-said").textContent = checks.length ? `${passed}.` : "";
  for (const [mark, tone, name, value, meaning] of checks) {
    for (const host of tone === "good" ? ["checks"] : ["failures", "checks"]) {
      const item = put($(host), "li", undefined, tone);
      put(item, "span", mark, "mark").setAttribute("aria-hidden", "true");
      const what = put(item, "span", undefined, "what");
      put(what, "b", name);
      what.append(` ${value}`);
      put(item, "span", meaning, "why");
    }
  }
}

function showTrade() {
  const subject = subjects[chosen];
  const marks = subject.rules
    .filter((each) => each.rule !== "robust" && each.ms[0] !== null && each.ms[1] !== null && each.ms[0] <= 4)
    .map((each) => ({ x: each.ms[0], y: each.ms[1], kind: each.rule === asked.rule ? "chosen" : "rule", name: each.rule }));
  if (shaped) marks.push({ x: shaped.at[0], y: shaped.at[1], kind: "here", name: "" });
  const curves = ["pi", "pid"].map((kind) => {
    const points = (trades[chosen] || []).filter((p) => p[0] === kind && p[2] !== null).sort((a, b) => a[1] - b[1]);
    return { x: points.map((p) => p[1]), y: points.map((p) => p[2]), kind, name: kind.toUpperCase() };
  }).filter((curve) => curve.x.length > 1);
  const said = shaped ? `here Ms ${shaped.at[0]}, IAE ${shaped.at[1]} y s/u` : "";
  plots.trade.draw({ curves, marks, said });
}

function gainsWords(s) {
  return s.isa.filter(([name, value]) => value !== "0" && name !== "tf")
    .map(([name, value, unit]) => `${name} ${value}${unit ? ` ${unit}` : ""}`);
}

// A step of the set-point and one of the load, behind it those of the present gains.
function showSteps(t) {
  const { steps } = subjects[chosen].present;
  const before = (k) => (steps ? [{ x: steps[0], y: steps[k], kind: "before", name: k === 1 ? "the present gains" : "" }] : []);
  const end = t.time[t.time.length - 1];
  const load = [{ x: t.load_time, kind: "load" }];
  const highest = Math.max(...t.measurement.filter((v) => v !== null));
  plots.measurement.draw({
    xs: [0, end],
    ys: [Math.max(-1, Math.min(-0.1, ...t.measurement)), Math.min(2.5, Math.max(1.6, 1.1 * highest))],
    bands: [{ x: t.time, low: t.low, high: t.high, kind: "", name: "95 % of the models" }].filter((b) => b.low.length),
    curves: [...before(1), { x: t.time, y: t.measurement, kind: "model", name: "these gains" }],
    lines: [...load, { y: 1, kind: "setpoint" }],
    said: `highest ${highest.toFixed(2)} after a set-point step of 1 y, then a load step of ${t.load} u`,
  });
  plots.command.draw({ xs: [0, end], curves: [...before(2), { x: t.time, y: t.command, kind: "input" }], lines: load });
}

// s: gains and what they do; of a sketch the exact ones follow, with their verdict
function showShaped(s, sketched) {
  document.body.classList.toggle("sketched", sketched);
  if (!sketched) {
    showVerdict(s.verdict, s.checks);
    $("command").textContent = s.command;
    showKeep(s.exports);
    showTrade();
    const { rows } = subjects[chosen].present;
    $("beside-box").hidden = !rows.length;
    table($("beside"), rows.map(([name, now], k) => [name, now, s.beside[k]]), []);
    if (live) live.showForce();
  }
  $("gains").textContent = sketched ? "about " : "";
  for (const words of gainsWords(s)) { put($("gains"), "span", words); $("gains").append("   "); }
  table($("isa"), s.isa, ["", "number", "unit", "meaning"]);
  table($("parallel"), s.parallel, ["", "number", "unit"]);
  table($("effects"), s.effects, ["", "", "interval"]);
  $("why").textContent = `Rule ${s.rule}: ${s.reason}`;
  const notes = [...s.warnings, ...s.remarks];
  $("notes").hidden = !notes.length;
  $("notes-title").textContent = s.warnings.length ? "Read this first" : "To be known";
  $("warnings").replaceChildren();
  for (const text of notes) put($("warnings"), "li", text);
  $("weight-value").textContent = s.b.toFixed(2);
  if (asked.setpoint_weight === null) $("weight").value = s.b;
  showSteps(s.steps);
  const circle = { x: [], y: [], kind: "limit", name: `Ms of the model, ${s.ms.toFixed(2)}` };
  for (let k = 0; k <= 90; k += 1) {
    circle.x.push(-1 + Math.cos((k * Math.PI) / 45) / s.ms);
    circle.y.push(Math.sin((k * Math.PI) / 45) / s.ms);
  }
  plots.nyquist.draw({
    square: true, xs: [-2.3, 1.3], ys: [-2.0, 1.2], areas: s.nyquist.band,
    curves: [circle, { x: s.nyquist.re, y: s.nyquist.im, kind: "loop", name: "loop" }],
    marks: [{ x: -1, y: 0, kind: "point", name: "-1" }],
    said: `it comes as near to -1 as ${(1 / s.ms).toFixed(2)}`,
  });
}

// The files that the gains can be written into, which depend on their law.
function showKeep(exports) {
  if (keeps === String(exports)) return;
  keeps = String(exports);
  $("keep").replaceChildren();
  button($("keep"), "Report as one file", () => download("report.html", {}));
  for (const name of exports) button($("keep"), exported(name), () => exportGains(name));
}

function showRefused(text) {
  document.body.classList.remove("sketched");
  $("refused").hidden = false;
  $("refused").textContent = text;
  $("gains").textContent = "no gains";
  $("verdict").textContent = "no gains";
  $("verdict").className = "chip bad";
  for (const id of ["isa", "parallel", "effects", "beside"]) $(id).replaceChildren();
  $("command").textContent = "";
  for (const name of ["measurement", "command", "nyquist"]) plots[name].draw({ curves: [] });
  if (live) live.showForce();
}

function showSubject() {
  const subject = subjects[chosen];
  const name = live ? live.snapshot.node : subject.name;
  $("name").textContent = name;
  document.title = `${name} - relay_autotune`;
  $("facts").replaceChildren();
  if (live) put($("facts"), "li", subject.name);
  for (const text of subject.facts) put($("facts"), "li", text);
  $("shape").hidden = !subject.may_shape;
  $("calm-fast").hidden = !subject.may_shape;
  $("reason").hidden = !subject.reason || subject.may_shape;
  $("reason").textContent = subject.reason;
  showVerdict(subject.verdict, subject.checks);
  $("process").textContent = subject.process;
  $("structure").textContent = subject.structure && `structure ${subject.structure}`;
  table($("estimates"), subject.estimates, ["", "", "unit", "interval"]);
  $("record").hidden = !subject.record;
  if (subject.record) {
    const r = subject.record;
    const curves = [{ x: r.measurement[0], y: r.measurement[1], kind: "measured", name: "measurement" }];
    if (r.model) curves.push({ x: r.model[0], y: r.model[1], kind: "model", name: "model" });
    plots.record.draw({ curves });
    plots.relay.draw({ curves: [{ x: r.command[0], y: r.command[1], kind: "input" }] });
  }
  $("tabs").replaceChildren();
  const here = subjects.map((each, k) => [each, k]).filter(([each]) => each.loop === subject.loop);
  $("tabs").hidden = here.length < 2;
  here.forEach(([each, k]) => {
    const tab = button($("tabs"), each.when ? `tune at ${each.when}` : each.name, () => choose(k));
    tab.setAttribute("aria-pressed", String(k === chosen));
  });
}

// Which tune the gains are of: after one without gains those before stay.
function showOf() {
  const { when } = subjects[chosen];
  const none = Boolean(when) && live.snapshot.tuned < 0;
  document.body.classList.toggle("old", none);
  const last = none && live.snapshot.phase === "idle" ? `; the last tune, at ${live.snapshot.began}, gave none` : "";
  $("gains-of").textContent = when ? `of the tune at ${when}${last}` : "";
}

function choose(k) {
  chosen = k;
  shaped = null;
  // Those of another model.
  $("gains").textContent = subjects[k].may_shape ? "" : "no gains";
  $("notes").hidden = true;
  asked = remembered(subjects[k]);
  showSubject();
  showControls();
  showOf();
  ask();
}

// A law is that of a program; the others are forms of a file.
function exported(name) { return `Gains ${laws.includes(name) ? "for" : "as"} ${name}`; }

function exportGains(name) {
  if (!(shaped && shaped.doubtful)) { download(`gains/${name}`, {}); return; }
  plan.begin(exported(name), "Write them all the same", () => download(`gains/${name}`, { accept_doubtful: "yes" }));
  plan.say("The file will say that they are doubtful.", [["note", "doubtful", shaped.doubtful]], true);
}

async function download(path, more) {
  const words = new URLSearchParams({ of: chosen, asked: JSON.stringify(asked), ...more });
  let file = path;
  $("kept").textContent = `writing ${file}`;
  try {
    const answer = await fetch(`${path}?${words}`);
    if (!answer.ok) throw new Error(await answer.text());
    [, file] = answer.headers.get("Content-Disposition").match(/filename="(.*)"/);
    const link = document.createElement("a");
    link.href = URL.createObjectURL(await answer.blob());
    link.download = file;
    link.click();
    URL.revokeObjectURL(link.href);
    $("kept").textContent = `${file} is among your downloads`;
  } catch (error) {
    $("kept").textContent = `${file} was not written: ${error.message}`;
  }
}

// The gains that the page shows now, for the running controller.
function offered() {
  if (!shaped || subjects[chosen].loop !== live.loop.number) return null;
  return { wish: { of: chosen, asked: shaped.asked }, words: gainsWords(shaped).join(", "), doubtful: shaped.doubtful };
}

// Another loop is shown, with its newest model.
function showLoop() {
  const k = subjects.map((each) => each.loop).lastIndexOf(live.loop.number);
  for (const id of ["data", "shape", "calm-fast"]) $(id).hidden = k < 0;
  if (k >= 0) { choose(k); return; }
  chosen = -1;
  shaped = null;
  $("name").textContent = live.snapshot.node;
  document.title = `${live.snapshot.node} - relay_autotune`;
  $("facts").replaceChildren();
  $("gains").textContent = $("verdict").textContent = "";
  $("notes").hidden = true;
  $("marks").textContent = $("gains-of").textContent = saidChecks = "";
  live.showForce();
}

const plan = new Plan();
let live = null; // made when the server has a loop to watch

// What stands in the bar until something else is done; empty: nothing.
function warn(text) {
  $("gone").hidden = !text;
  $("gone").textContent = text;
}

function take(message) {
  if (message.refused) { warn(message.refused); return; }
  if (message.live || message.samples || message.shown) {
    live ??= new Live((what, more) => { warn(""); socket.send(JSON.stringify({ do: what, ...more })); }, plan, offered, showLoop);
    live.take(message);
    if (chosen >= 0) showOf();
    return;
  }
  if (message.subjects) {
    const before = subjects.length;
    subjects = message.subjects;
    laws = message.laws;
    Object.assign(units, message.units);
    $("data").hidden = $("shape").hidden = !subjects.length;
    const of = Number(new URLSearchParams(location.hash.slice(1)).get("of") ?? -1);
    if (!live) { choose(of >= 0 && of < subjects.length ? of : 0); return; }
    const own = subjects.map((each, k) => k).filter((k) => subjects[k].loop === live.loop.number);
    const newest = own[own.length - 1];
    // After a tune its own result is shown, else what the address says.
    if (!own.length) showLoop();
    else if (before && newest < before) {
      // Other rules of the same model have come, or the present gains are others.
      showSubject();
      showControls();
      if (shaped) showShaped(shaped, false);
    }
    else choose(!before && own.includes(of) ? of : newest);
    return;
  }
  if (message.trade_off) {
    trades[message.of] = message.trade_off;
    if (message.of === chosen) showTrade();
    return;
  }
  const { sketched } = message.answer;
  // Once gains that come near are shown, the next question need not wait for the exact ones.
  if (message.n === waiting) waiting = 0;
  if (message.n !== number) return;
  if (message.of === chosen) {
    if (sketched) {
      shaped = null;
      $("refused").hidden = true;
      showShaped(sketched, true);
      if (live) live.showForce();
    } else if (message.answer.shaped) {
      shaped = message.answer.shaped;
      $("refused").hidden = true;
      showShaped(shaped, false);
    } else {
      shaped = null;
      showRefused(message.answer.refused);
    }
    document.body.dataset.shown = message.n;
    document.body.dataset.took = (performance.now() - begun).toFixed(1);
  }
  if (changed) ask();
  else if (!sketched) document.body.dataset.settled = "yes";
}

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket`);
  socket.addEventListener("open", () => { warn(""); waiting = 0; });
  socket.addEventListener("message", (event) => take(JSON.parse(event.data)));
  socket.addEventListener("close", () => {
    warn("The command that serves this page has ended, or cannot be reached; the page shows what it knew last.");
    setTimeout(connect, 1000);
  });
}

$("ms").addEventListener("input", () => {
  asked.ms = Number($("ms").value);
  $("ms-value").textContent = asked.ms.toFixed(2);
  ask();
});
for (const input of document.querySelectorAll("input[name=controller]")) {
  input.addEventListener("change", () => { asked.controller = input.value; ask(); });
}
$("noise-share").addEventListener("input", () => {
  asked.noise_share = Number($("noise-share").value);
  showNoise();
  ask();
});
$("law").addEventListener("change", () => { asked.law = $("law").value; ask(); });
$("rate").addEventListener("change", () => { asked.sample_period = Math.max(0, Number($("rate").value)); ask(); });
$("rule").addEventListener("change", () => { asked.rule = $("rule").value; ask(); });
$("own-weight").addEventListener("change", () => {
  asked.setpoint_weight = $("own-weight").checked ? null : Number($("weight").value);
  showControls();
  ask();
});
$("weight").addEventListener("input", () => {
  asked.setpoint_weight = Number($("weight").value);
  $("weight-value").textContent = asked.setpoint_weight.toFixed(2);
  ask();
});
$("copy").addEventListener("click", async () => {
  try {
    await navigator.clipboard.writeText($("command").textContent);
    $("kept").textContent = "The command is in the clipboard.";
  } catch {
    getSelection().selectAllChildren($("command"));
    $("kept").textContent = "The command is selected: copy it.";
  }
});
// A browser moves a slider at the first touch; where the finger then scrolls, it goes back.
for (const slider of document.querySelectorAll("input[type=range]")) {
  let before = slider.value;
  slider.addEventListener("pointerdown", () => { before = slider.value; });
  slider.addEventListener("pointercancel", () => {
    slider.value = before;
    slider.dispatchEvent(new Event("input"));
  });
}
$("theme").addEventListener("click", () => {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
});
connect();
