// The list of walkers: one line each, the chosen one with its sensors' health.

import { HINTS, accuracy, direction, isDirected, isStale, stateLine } from "./words.js";

const here = (id) => document.getElementById(id);
const make = (name, className = "", text = "") => {
  const element = document.createElement(name);
  if (className) element.className = className;
  element.textContent = text;
  return element;
};
const put = (element, text) => {
  if (element.textContent !== text) element.textContent = text; // else screen readers start anew
};

export class Panel {
  constructor(choose) {
    this.choose = choose;
    this.entries = new Map();
  }

  entryOf(walker) {
    const known = this.entries.get(walker);
    if (known) return known;
    const item = make("li"),
      button = make("button", "walker"),
      detail = make("div", "detail");
    item.style.setProperty("--colour", walker.colour);
    button.type = "button";
    const parts = { item, button, detail, name: make("span", "name"), sigma: make("span", "sigma"), state: make("span", "state") };
    detail.id = `detail-${walker.number}`;
    button.setAttribute("aria-controls", detail.id);
    button.append(make("span", "dot"), parts.name, parts.sigma, parts.state);
    button.addEventListener("click", () => this.choose(walker));
    item.append(button, detail);
    here("walkers").append(item);
    this.entries.set(walker, parts);
    return parts;
  }

  // open: whether the chosen walker's details are shown.
  show(walkers, chosen, open) {
    const now = performance.now();
    for (const walker of walkers) {
      const { item, button, detail, name, sigma, state } = this.entryOf(walker);
      item.classList.toggle("stale", isStale(walker, now));
      item.classList.toggle("finished", walker.finished);
      put(name, walker.pose.name);
      put(sigma, accuracy(walker.pose.sigma));
      const shown = walker === chosen && open;
      put(state, stateLine(walker, now, shown));
      item.classList.toggle("chosen", walker === chosen && walkers.length > 1);
      button.setAttribute("aria-expanded", shown);
      detail.hidden = !shown;
      if (shown) this.showDetail(detail, walker.pose);
    }
    for (const [walker, { item }] of this.entries) {
      if (walkers.includes(walker)) continue;
      item.remove();
      this.entries.delete(walker);
    }
    here("empty").hidden = walkers.length > 0;
  }

  showDetail(detail, pose) {
    const said = JSON.stringify([pose.state, pose.missing, pose.issues, pose.health, pose.bearing, pose.steps, pose.notes]);
    if (detail.dataset.said === said) return; // nothing new
    detail.dataset.said = said;
    const hint = pose.missing.length ? pose.missing.map((line) => `helps: ${line}`).join("; ") : HINTS[pose.state] || "";
    const issues = make("ul"),
      sensors = make("dl"),
      figures = make("dl");
    issues.append(...pose.issues.map((line) => make("li", "", line)));
    for (const [sensor, text] of Object.entries(pose.health)) {
      const issue = pose.issues.some((line) => line.startsWith(`${sensor}:`)) || !/\d Hz/.test(text);
      sensors.append(make("dt", "", sensor), make("dd", issue ? "issue" : "", text));
    }
    const notes = (pose.notes || []).map((line) => make("p", "note soft", line));
    const rows = [
      ["heading", isDirected(pose) ? `${direction(pose.bearing)}, ${Math.round(pose.bearing)}°` : "not known yet"],
      ["steps", String(pose.steps || 0)],
      ["ways that remain", pose.modes.length > 1 ? String(pose.modes.length) : ""],
    ];
    for (const [term, text] of rows) if (text) figures.append(make("dt", "", term), make("dd", "plain", text));
    detail.replaceChildren(...(hint ? [make("p", "hint soft", hint)] : []), issues, ...(sensors.children.length ? [sensors] : []), figures, ...notes);
  }
}

// Tell a screen reader what has changed.
export const speak = (text) => put(here("spoken"), text);

// A line above the list; empty: none.
export const notice = (text) => {
  here("notice").hidden = !text;
  put(here("notice"), text);
};
