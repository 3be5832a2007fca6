"use strict";
// The page is whole without this: it hides methods, says values, sorts and filters tables, and changes axes.
const all = (query, root = document) => [...root.querySelectorAll(query)];

// A legend's entry is a switch for its method in all figures.
const hidden = new Set();
function toggle(method) {
  if (!hidden.delete(method)) hidden.add(method);
  for (const part of all("[data-method]")) part.classList.toggle("hidden", hidden.has(part.dataset.method));
  for (const entry of all("[data-choice]")) {
    const off = hidden.has(entry.dataset.choice);
    entry.classList.toggle("off", off);
    entry.setAttribute("aria-pressed", String(!off));
  }
}
for (const entry of all("[data-choice]")) {
  entry.closest("svg").setAttribute("role", "group"); // an image has no switches inside
  entry.setAttribute("tabindex", "0");
  entry.setAttribute("role", "button");
  entry.setAttribute("aria-label", "show or hide " + entry.dataset.choice);
  entry.setAttribute("aria-pressed", "true");
  entry.addEventListener("click", () => toggle(entry.dataset.choice));
  entry.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    toggle(entry.dataset.choice);
  });
}

// Hovering says the method and the values of the nearest point.
const tip = document.createElement("div");
tip.className = "tip";
tip.hidden = true;
document.body.append(tip);

function vertices(group) {
  const path = group.querySelector("path");
  const numbers = group.dataset.values ? group.dataset.values.split(";").map((pair) => pair.split(",")) : [];
  let places = path ? [...path.getAttribute("d").matchAll(/[ML]\s*(-?[\d.]+)\s+(-?[\d.]+)/g)].map((m) => [+m[1], +m[2]]) : [];
  if (places.length !== numbers.length || group.querySelector("defs path") === path) {
    places = all("use", group).map((use) => [+use.getAttribute("x"), +use.getAttribute("y")]);
  }
  return places.length === numbers.length ? places.map((place, k) => [place, numbers[k]]) : [];
}

function nearest(svg, event) {
  const matrix = svg.getScreenCTM();
  let best = null;
  for (const group of all("[data-values]:not(.hidden)", svg)) {
    for (const [[x, y], values] of vertices(group)) {
      const at = new DOMPoint(x, y).matrixTransform(matrix);
      const apart = Math.hypot(at.x - event.clientX, at.y - event.clientY);
      if (apart < 14 && (!best || apart < best.apart)) best = { apart, values, method: group.dataset.method };
    }
  }
  return best;
}

for (const svg of all(".drawing > svg")) {
  svg.addEventListener("pointermove", (event) => {
    const found = nearest(svg, event);
    tip.hidden = !found;
    if (!found) return;
    tip.textContent = `${found.method}: ${found.values[1]} at ${found.values[0]}`;
    tip.style.left = Math.min(event.pageX + 12, scrollX + innerWidth - tip.offsetWidth - 8) + "px";
    tip.style.top = event.pageY + 14 + "px";
  });
  svg.addEventListener("pointerleave", () => (tip.hidden = true));
}

// Logarithmic or linear axes, where a figure has both.
for (const figure of all("figure")) {
  if (!figure.querySelector(".linear")) continue;
  const button = document.createElement("button");
  button.textContent = "linear axes";
  button.addEventListener("click", () => {
    const linear = figure.classList.toggle("show-linear");
    button.textContent = linear ? "logarithmic axes" : "linear axes";
  });
  figure.querySelector("h3").after(button);
}

// Tables: a click on a head sorts, a box filters the rows.
const superscript = { "⁻": "-" };
"⁰¹²³⁴⁵⁶⁷⁸⁹".split("").forEach((raised, k) => (superscript[raised] = String(k)));
function value(cell) {
  const text = cell.textContent.trim().replace(/−/g, "-");
  if (text === "exact") return 0;
  const found = text.match(/^(-?[\d.]+)(?:·10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?/);
  if (!found) return text;
  const exponent = found[2] ? +[...found[2]].map((c) => superscript[c]).join("") : 0;
  return +found[1] * 10 ** exponent;
}
function sort(table, column, head) {
  const down = head.getAttribute("aria-sort") === "ascending";
  for (const other of all("th", table)) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const body = table.tBodies[0];
  const rows = [...body.rows].map((row) => [value(row.cells[column] ?? row.cells[0]), row]);
  const before = (a, b) => (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b)));
  rows.sort((a, b) => (down ? -1 : 1) * before(a[0], b[0]));
  body.append(...rows.map(([, row]) => row));
}
for (const table of all("table.sortable")) {
  all("thead th", table).forEach((head, column) => {
    head.setAttribute("tabindex", "0");
    const act = () => sort(table, column, head);
    head.addEventListener("click", act);
    head.addEventListener("keydown", (event) => event.key === "Enter" && act());
  });
  const box = document.createElement("input");
  box.type = "search";
  box.placeholder = "filter rows";
  box.setAttribute("aria-label", "filter rows");
  box.addEventListener("input", () => {
    const words = box.value.toLowerCase().split(/\s+/);
    for (const row of table.tBodies[0].rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
    }
  });
  table.parentElement.before(box);
}
