// Copyright 2026 the developers of relay_autotune
// SPDX-License-Identifier: Apache-2.0

// Elements of the page, and small figures in SVG. Colours and dashes come from the style sheet, by
// the class of a curve.

export const $ = (id) => document.getElementById(id);

export function put(parent, name, text, kind) {
  const made = document.createElement(name);
  if (text !== undefined) made.textContent = text;
  if (kind) made.className = kind;
  parent.append(made);
  return made;
}

export function button(parent, text, work) {
  const made = put(parent, "button", text);
  made.type = "button";
  made.addEventListener("click", work);
  return made;
}

const SVG = "http://www.w3.org/2000/svg";

function element(name, attributes, parent) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (parent) parent.append(made);
  return made;
}

export function ticks(low, high, count) {
  const rough = (high - low) / Math.max(count, 1);
  if (!(rough > 0) || !Number.isFinite(rough)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((k) => k * power).find((s) => s >= 0.999 * rough);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) {
    found.push(Number((k * step).toPrecision(12)));
  }
  return found;
}

function range(values) {
  let low = Infinity;
  let high = -Infinity;
  for (const list of values) {
    for (const value of list) {
      if (value === null) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  if (!(low <= high)) return [0, 1];
  const room = 0.06 * (high - low) || 0.5 * Math.abs(high) || 1;
  return [low - room, high + room];
}

// What y and u stand for, by their letters.
export const units = {};

export function inUnits(label) {
  return (label || "").replace(/\[(.*)\]/, (all, unit) => `[${unit.replace(/[yu]/g, (letter) => units[letter] || letter)}]`);
}

export class Plot {
  // host: an empty element; words: {label, x, y} of the figure and its axes; pick: called with the name of a mark
  constructor(host, words) {
    this.host = host;
    this.words = words;
    this.drawn = null;
    this.svg = element("svg", { role: "img", "aria-label": words.label }, host);
    this.legend = put(host, "ul", undefined, "legend");
    new ResizeObserver(() => this.redraw()).observe(host);
  }

  // what: {curves: [{x, y, kind, name}], bands: [{x, low, high, kind, name}],
  //        areas: [[x, y, x, y, ...]], marks: [{x, y, kind, name}], lines: [{at, kind}],
  //        xs, ys: ranges that are wanted, square, said: the figure in words}
  draw(what) {
    this.drawn = what;
    this.redraw();
  }

  redraw() {
    const what = this.drawn;
    const width = Math.round(this.host.clientWidth);
    if (!what || width < 60) return;
    const height = what.square ? Math.min(width, 430) : Math.round(Math.min(260, 0.5 * width + 60));
    const right = 10, top = 8, below = this.words.x ? 36 : 20;
    const curves = what.curves || [];
    const bands = what.bands || [];
    const marks = what.marks || [];
    let xs = what.xs || range([...curves.map((c) => c.x), marks.map((m) => m.x)]);
    if (!(xs[1] > xs[0])) xs = [xs[0] - 0.5, xs[0] + 0.5];
    const ys = what.ys || range(
      [...curves.map((c) => c.y), ...bands.map((b) => b.low), ...bands.map((b) => b.high),
        marks.map((m) => m.y)]);
    const levels = ticks(ys[0], ys[1], height / 50).map((y) => [y, String(y)]);
    // Room for the numbers beside the axis's title; figures below one another have the same if they can.
    const left = Math.max(62, 22 + 6.4 * Math.max(...levels.map(([, text]) => text.length)));
    if (what.square) {
      const middle = (xs[0] + xs[1]) / 2;
      const half = ((ys[1] - ys[0]) / 2) * ((width - left - right) / (height - top - below));
      xs = [middle - half, middle + half];
    }
    const px = (x) => left + ((x - xs[0]) / (xs[1] - xs[0])) * (width - left - right);
    const py = (y) => height - below - ((y - ys[0]) / (ys[1] - ys[0])) * (height - top - below);
    const svg = this.svg;
    svg.replaceChildren();
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    svg.setAttribute("width", width);
    svg.setAttribute("height", height);
    svg.setAttribute("aria-label", what.said ? `${this.words.label}: ${what.said}` : this.words.label);
    const clip = `clip-${this.host.id}`;
    element("rect", { x: left, y: top, width: width - left - right, height: height - top - below },
      element("clipPath", { id: clip }, svg));
    for (const x of ticks(xs[0], xs[1], width / 90)) {
      element("path", { class: "grid-line", d: `M${px(x)} ${top}V${height - below}` }, svg);
      element("text", { class: "tick", x: px(x), y: height - below + 14, "text-anchor": "middle" }, svg)
        .textContent = String(x);
    }
    for (const [y, text] of levels) {
      element("path", { class: "grid-line", d: `M${left} ${py(y)}H${width - right}` }, svg);
      element("text", { class: "tick", x: left - 6, y: py(y) + 4, "text-anchor": "end" }, svg)
        .textContent = text;
    }
    element("text", { class: "axis", x: (left + width - right) / 2, y: height - 4, "text-anchor": "middle" }, svg)
      .textContent = inUnits(this.words.x);
    element("text", { class: "axis", transform: `translate(12 ${(top + height - below) / 2}) rotate(-90)`, "text-anchor": "middle" }, svg)
      .textContent = inUnits(this.words.y);
    const inside = element("g", { "clip-path": `url(#${clip})` }, svg);
    const at = (x, y) => `${px(x).toFixed(1)} ${py(y).toFixed(1)}`;
    if (what.areas && what.areas.length) {
      let d = "";
      for (const area of what.areas) {
        for (let k = 0; k < area.length; k += 2) d += (k ? "L" : "M") + at(area[k], area[k + 1]);
        d += "Z";
      }
      element("path", { class: "band", d }, inside);
    }
    for (const band of bands) {
      if (!band.low.length) continue;
      let d = "";
      band.x.forEach((x, k) => { d += (k ? "L" : "M") + at(x, band.high[k]); });
      for (let k = band.x.length - 1; k >= 0; k -= 1) d += `L${at(band.x[k], band.low[k])}`;
      element("path", { class: `band ${band.kind || ""}`, d: `${d}Z` }, inside);
    }
    for (const line of what.lines || []) {
      const d = line.y === undefined ? `M${px(line.x)} ${top}V${height - below}` : `M${left} ${py(line.y)}H${width - right}`;
      element("path", { class: `line ${line.kind || ""}`, d }, inside);
    }
    for (const curve of curves) {
      let d = "";
      let pen = "M";
      curve.x.forEach((x, k) => {
        const y = curve.y[k];
        if (x === null || y === null || y === undefined) { pen = "M"; return; }
        d += pen + at(x, y);
        pen = "L";
      });
      element("path", { class: `curve ${curve.kind}`, d }, inside);
    }
    // No name stands on a mark.
    const taken = marks.map((mark) => ({ y: py(mark.y), start: px(mark.x) - 5, end: px(mark.x) + 5 }));
    for (const mark of marks) {
      const x = px(mark.x), y = py(mark.y);
      const group = element("g", { class: `mark ${mark.kind}`, transform: `translate(${x.toFixed(1)} ${y.toFixed(1)})` }, inside);
      element("circle", { r: mark.kind === "here" ? 6 : 4 }, group);
      if (!mark.name) continue;
      element("title", {}, group).textContent = mark.name;
      if (this.words.pick) group.addEventListener("click", () => this.words.pick(mark.name));
      // A name stands right or left of its mark, above or below it, or is left out where others
      // stand already; the pointer still finds it.
      const label = element("text", { x: 0, y: 4 }, group);
      label.textContent = mark.name;
      const long = label.getComputedTextLength();
      const free = [[9, 0], [-9 - long, 0], [-long / 2, -14], [-long / 2, 14]].find(([dx, dy]) => {
        const box = { y: y + dy, start: x + dx, end: x + dx + long };
        return box.start >= left && box.end <= width - right && box.y > top + 8 && box.y < height - below - 6 && taken.every((t) => Math.abs(t.y - box.y) > 13 || box.start > t.end + 3 || box.end < t.start - 3);
      });
      if (!free) { label.remove(); continue; }
      taken.push({ y: y + free[1], start: x + free[0], end: x + free[0] + long });
      label.setAttribute("x", free[0]);
      label.setAttribute("y", 4 + free[1]);
    }
    const lines = (what.names || []).map(([kind, name]) => ({ kind: `line ${kind}`, name }));
    const named = [...bands, ...curves, ...lines].filter((each) => each.name);
    const key = named.map((each) => each.name + each.kind).join();
    if (this.key === key) return;
    this.key = key;
    this.legend.replaceChildren();
    for (const each of named) {
      const item = put(this.legend, "li");
      put(item, "span", undefined, `swatch ${each.kind} ${each.low ? "band" : ""}`);
      item.append(each.name);
    }
  }
}
