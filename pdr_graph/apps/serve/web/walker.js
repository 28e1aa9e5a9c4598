// A walker: its latest pose, its path, and its dot on the map.

import { apart, feature, linesOf, outline, place, rows, shownAt } from "./geo.js";
import { isDirected } from "./words.js";

const GLIDE = 800; // [ms] in which the dot moves to the next pose
const NINETY = 1.645; // standard deviations on both sides that hold 90 %
const REACH = 46; // [px] length of the cone
const LONGEST_TAIL = 12; // [m] from the end of the path to the dot: the path comes every other second
const FAINT = 0.02; // probability of a way below which it is not shown
const SVG = "http://www.w3.org/2000/svg";
const still = matchMedia("(prefers-reduced-motion: reduce)");

const drawn = (name, attributes, parent) => {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  parent.append(element);
  return element;
};

// How long ago [s] a pose was, by the phone's clock; 0 if that is in the future.
const ageOf = ({ time }) => (time === null ? 0 : Math.max(0, Date.now() / 1000 - time));

// The dot with its cone, which points up, and the name.
const pinOf = (colour, id) => {
  const pin = document.createElement("div");
  pin.className = "pin";
  const svg = drawn("svg", { viewBox: "-60 -60 120 120", "aria-hidden": "true" }, pin);
  const fade = drawn("radialGradient", { id: `fade-${id}`, gradientUnits: "userSpaceOnUse", cx: 0, cy: 0, r: REACH }, drawn("defs", {}, svg));
  drawn("stop", { offset: 0.2, "stop-color": colour, "stop-opacity": 0.75 }, fade);
  drawn("stop", { offset: 1, "stop-color": colour, "stop-opacity": 0.05 }, fade);
  const cone = drawn("path", { class: "cone", fill: `url(#fade-${id})` }, svg);
  drawn("circle", { class: "dot", r: 9, fill: colour, stroke: "#fff", "stroke-width": 3 }, svg);
  const label = pin.appendChild(document.createElement("span"));
  label.className = "label";
  return { pin, cone, label };
};

// A sector of a half angle [rad] about the direction up.
const sector = (half) => {
  const x = REACH * Math.sin(half),
    y = -REACH * Math.cos(half);
  return `M0 0L${-x} ${y}A${REACH} ${REACH} 0 ${half > Math.PI / 2 ? 1 : 0} 1 ${x} ${y}Z`;
};

// A path: its finalised rows, and the current ones, which are still corrected.
export class Path {
  constructor() {
    this.finalised = [];
    this.current = [];
  }

  // Take an event "path": its finalised rows follow the first `from` ones, its current part replaces the former.
  extend(event) {
    this.finalised = [...this.finalised.slice(0, event.from), ...rows(event.finalised)];
    this.current = rows(event.current);
  }
}

export class Walker {
  constructor(number, colour, pose, path) {
    Object.assign(this, { number, colour, pose, path, heard: performance.now() - 1000 * ageOf(pose) });
    this.parts = pinOf(colour, number);
    this.marker = null;
    this.at = null; // where the dot is drawn
  }

  get finished() {
    return this.pose.state === "finished";
  }

  // Take a pose. One that is sent again, to a page that was not connected, is no news of the phone.
  update(pose, map) {
    if (pose.message !== this.pose.message || pose.time !== this.pose.time) this.heard = performance.now();
    this.pose = pose;
    const { pin, cone, label } = this.parts;
    label.textContent = pose.name;
    const to = shownAt(pose);
    if (!map || !to) return;
    if (!this.marker) {
      this.marker = new maplibregl.Marker({ element: pin, rotationAlignment: "map" }).setLngLat(to).addTo(map);
      pin.setAttribute("role", "img");
    }
    const sure = isDirected(pose) && !this.finished;
    pin.setAttribute("aria-label", `${pose.name}: ${pose.state}`);
    cone.setAttribute("d", sure ? sector(Math.max(0.15, NINETY * pose.heading_sigma)) : "");
    if (sure) cone.setAttribute("transform", `rotate(${pose.bearing})`);
    pin.classList.toggle("south", sure && Math.cos((pose.bearing * Math.PI) / 180) < 0); // the name is not on the cone
    this.glide(to);
  }

  glide(to) {
    cancelAnimationFrame(this.frame);
    const from = this.at || to,
      begun = performance.now();
    const step = (now) => {
      const share = still.matches || document.hidden ? 1 : Math.min(1, Math.max(0, now - begun) / GLIDE);
      this.at = [from[0] + share * (to[0] - from[0]), from[1] + share * (to[1] - from[1])];
      this.marker.setLngLat(this.at);
      if (share < 1) this.frame = requestAnimationFrame(step);
    };
    step(begun);
  }

  // The finalised lines of the path.
  finalisedLines() {
    return linesOf(this.path.finalised, { id: this.pose.id, colour: this.colour });
  }

  // The lines that each event changes: the current part, which is still corrected, and from its end to the dot.
  currentLines() {
    const properties = { id: this.pose.id, colour: this.colour };
    const { finalised } = this.path,
      current = [...finalised.slice(-1), ...this.path.current],
      end = current[current.length - 1],
      to = shownAt(this.pose);
    const near = end && to && apart(end.at, to) < LONGEST_TAIL;
    const tail = near ? [end, { at: to, floor: this.pose.floor || end.floor }] : [];
    return [
      ...linesOf(current, { ...properties, part: "current" }),
      ...linesOf(tail, { ...properties, part: "tail" }),
    ];
  }

  // The 90 % regions: of the pose, and faint of the ways that remain if there are several.
  regions() {
    const { region, floor, modes } = this.pose;
    if (this.finished) return [];
    const of = (centre, ellipse, weight) =>
      feature("Polygon", [outline(centre, ellipse)], { id: this.pose.id, colour: this.colour, floor: floor || "", weight });
    const several = modes.length > 1 ? modes.filter(({ probability }) => probability >= FAINT) : [];
    const ways = several.map((mode) => of(place(mode), mode.region, 0.15 + 0.55 * mode.probability));
    return region ? [...ways, of(shownAt(this.pose), region, 1)] : ways;
  }

  positions() {
    const to = shownAt(this.pose);
    return [...this.path.finalised, ...this.path.current].map(({ at }) => at).concat(to ? [to] : []);
  }

  remove() {
    cancelAnimationFrame(this.frame);
    if (this.marker) this.marker.remove();
  }
}
