// Tables that change in place: only what differs is written, so a screen reader or a selection is not disturbed.
"use strict";

const element = (id) => document.getElementById(id);

function make(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

// Whether a button of the mouse or a finger is down: what moves away under it would take the click.
const MOST_PRESS_MS = 2000;
let pressedMs = -Infinity;
addEventListener("pointerdown", () => { pressedMs = performance.now(); }, true);
for (const end of ["pointerup", "pointercancel"]) addEventListener(end, () => { pressedMs = -Infinity; }, true);
const isPressed = () => performance.now() - pressedMs < MOST_PRESS_MS;

function setText(node, text) {
  const shown = visible(text);
  if (node.textContent !== shown) node.textContent = shown;
}

function setClass(node, name) {
  if (node.className !== name) node.className = name;
}

// Rows by key, in the order given. `fill(row, value)` writes cells; `cells` are made once for each row.
function makeTable(table, columns) {
  const body = table.tBodies[0], rows = new Map();
  const heads = [...table.tHead.rows[0].cells].map((cell) => cell.textContent);
  function update(entries, fill) {
    const keys = new Set(entries.map(([key]) => key));
    for (const [key, row] of rows) if (!keys.has(key)) {
      row.remove();
      rows.delete(key);
    }
    let before = null;
    for (const [key, value] of entries) {
      let row = rows.get(key);
      if (!row) {
        row = make("tr");
        for (let i = 0; i < columns; i++) row.append(make(i ? "td" : "th", i ? { "data-label": heads[i] } : { scope: "row" }));
        rows.set(key, row);
      }
      if (row.previousElementSibling !== before || row.parentNode !== body) body.insertBefore(row, before ? before.nextSibling : body.firstChild);
      before = row;
      fill(row, value);
    }
  }
  return { update };
}

// Buttons of a row: made again only when their list changes, so that a focused one stays.
function setButtons(cell, wanted) {
  const now = wanted.map(({ text, label, off }) => `${text}|${label}|${off || ""}`).join("\n");
  if (cell.dataset.buttons === now) return;
  const focused = cell.contains(document.activeElement) && document.activeElement.textContent;
  cell.dataset.buttons = now;
  cell.replaceChildren(...wanted.map(({ text, label, act, off }) => {
    const button = make("button", { type: "button", "aria-label": visible(label) }, text);
    if (off) {
      button.setAttribute("aria-disabled", "true");
      button.title = off;
    } else button.addEventListener("click", act);
    return button;
  }));
  if (focused) for (const button of cell.children) if (button.textContent === focused) button.focus();
}

// Fleet time, as thermofleet watch shows it.
function clock(seconds) {
  if (seconds === null || seconds === undefined) return "—";
  const whole = Math.floor(Math.max(0, seconds));
  return `${Math.floor(whole / 3600)}:${String(Math.floor(whole / 60) % 60).padStart(2, "0")}:${String(whole % 60).padStart(2, "0")}`;
}

const figure = (value, digits, unit) => value === null || value === undefined ? "—" : `${value.toFixed(digits)}${unit || ""}`;

function age(seconds) {
  if (seconds === null || seconds === undefined) return "—";
  return seconds < 10 ? `${Math.max(0, seconds).toFixed(1)} s` : seconds < 120 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`;
}
