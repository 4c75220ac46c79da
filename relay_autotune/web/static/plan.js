// Copyright 2026 the developers of relay_autotune
// SPDX-License-Identifier: Apache-2.0

// The plan: what will be done, what is asked for it, and whether it is agreed to.

import { $, inUnits, put } from "./plot.js";

// Time without a key after which what was typed is looked at [ms].
const TYPED = 500;
// Checks that say what a tune will do; of the others those that passed are folded away.
const PLAN = ["moves", "within", "switches", "holds", "levels", "limits", "at rest", "expected", "time"];
const MARKS = { ok: ["\u2713", "good"], note: ["!", "warn"], NO: ["\u2715", "bad"] };

function checklist(host, checks) {
  host.replaceChildren();
  for (const [mark, name, found] of checks) {
    const [sign, tone] = MARKS[mark] || [mark, ""];
    const line = put(host, "li", undefined, tone);
    for (const [kind, text] of [["mark", sign], ["name", name], ["found", found]]) put(line, "span", text, kind);
  }
}

export class Plan {
  constructor() {
    this.asked = () => {}; // called with what is typed when it has to be looked at
    this.form = null; // what is asked for; null: not known yet
    $("plan-leave").addEventListener("click", () => this.close());
    $("plan-check").addEventListener("click", () => this.ask());
    $("plan-yes").addEventListener("click", () => {
      const typed = this.typed();
      this.close();
      this.agreed(typed);
    });
    $("plan").addEventListener("close", () => clearTimeout(this.typing));
    $("form").addEventListener("input", () => {
      $("plan-yes").disabled = true;
      clearTimeout(this.typing);
      this.typing = setTimeout(() => this.ask(), TYPED);
    });
    $("form").addEventListener("submit", (event) => event.preventDefault());
  }

  get open() { return $("plan").open; }

  close() { $("plan").close(); }

  // title: what is to be done; yes: the word that agrees; agreed: called with what was typed;
  // asked: called with the same where the server has to say what will be done
  begin(title, yes, agreed, asked = () => {}) {
    Object.assign(this, { agreed, asked, form: null });
    $("plan-title").textContent = title;
    $("plan-yes").textContent = yes;
    $("form").replaceChildren();
    this.say("looking at the loop", []);
    $("plan").showModal();
    this.ask();
  }

  ask() {
    if (!this.open) return;
    const typed = this.typed();
    if (typed) { $("plan-yes").disabled = true; this.asked(typed); return; }
    this.say("Fill in all of them: nothing moves before you agree.", []);
  }

  // What is typed by name; null: something is missing.
  typed() {
    const found = {};
    for (const { name, needed } of this.form || []) {
      const texts = [...document.querySelectorAll(`#form input[name=${name}]`)].map((input) => input.value.trim());
      if (!needed && texts.every((text) => text === "")) continue;
      if (texts.some((text) => text === "" || !Number.isFinite(Number(text)))) return null;
      const numbers = texts.map(Number);
      found[name] = numbers.length > 1 ? numbers : numbers[0];
    }
    return found;
  }

  // plan: what the server says of what was asked
  show({ refusal, refused, lines, form }) {
    if (!this.form) {
      this.form = form;
      this.showForm();
      if (!this.typed()) {
        this.ask();
        [...$("form").querySelectorAll("input")].find((input) => input.value === "").focus();
        return;
      }
    }
    const calm = form.length ? "Nothing moves before you agree; it can be ended at any time." : "Nothing changes before you agree.";
    this.say(refusal || calm, lines, !refusal, Boolean(refusal), refused);
  }

  // ready: whether it can be agreed to; bad: whether it is refused, for the answer of that name
  say(text, lines, ready = false, bad = false, refused = "") {
    $("plan-said").textContent = text;
    $("plan-said").className = bad ? "bad" : "";
    $("plan-yes").disabled = !ready;
    $("plan-check").hidden = ready || !(this.form && this.typed());
    const folded = ([mark, name]) => mark === "ok" && !PLAN.includes(name);
    checklist($("plan-lines"), lines.filter((line) => !folded(line)));
    checklist($("plan-passed"), lines.filter(folded));
    $("plan-more").hidden = !lines.some(folded);
    $("plan-sum").textContent = `${lines.filter(folded).length} more checks passed`;
    for (const input of $("form").querySelectorAll("input")) {
      if (input.name === refused) input.setAttribute("aria-invalid", "true");
      else input.removeAttribute("aria-invalid");
    }
    // The way to the answer, unless another one is being typed.
    const first = $("form").querySelector("[aria-invalid]");
    if (first && document.activeElement.form !== $("form")) first.focus();
  }

  showForm() {
    for (const { name, question, unit, values, ends, now, needed } of this.form) {
      const row = put($("form"), "div");
      const label = put(row, "label", inUnits(`${question} [${unit}]`));
      const fields = put(row, "span");
      for (let k = 0; k < ends; k += 1) {
        const input = put(fields, "input");
        Object.assign(input, { name, type: "number", step: "any", value: values && values[k] !== null ? values[k] : "" });
        if (!needed) input.placeholder = "as it is";
        input.id = `form-${name}-${k}`;
        input.setAttribute("aria-describedby", "plan-said");
        if (k === 0) label.htmlFor = input.id;
        else input.setAttribute("aria-label", `${question}, upper end`);
      }
      if (now) fields.append(now);
    }
  }
}
