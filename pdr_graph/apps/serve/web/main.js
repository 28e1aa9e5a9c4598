// The page: walkers by their events, the view that follows one of them, floors, keys.

import { boxOf, collection } from "./geo.js";
import { walkerColour } from "./colours.js";
import { newMap, showFloor, showGrid } from "./map.js";
import { Panel, notice, speak } from "./panel.js";
import { address, fetched, listen } from "./stream.js";
import { Path, Walker } from "./walker.js";
import { isStale } from "./words.js";

const here = (id) => document.getElementById(id);
const ALONE = 20; // zoom level of a walker without a plan
const NARROW = 640; // [px] width up to which the list is a sheet at the bottom, as in page.css
const NAMES = 1000; // [ms] between two looks at who is stale

const walkers = new Map(), // by id
  paths = new Map();
const pathOf = (id) => paths.get(id) || paths.set(id, new Path()).get(id);
const state = { map: null, chosen: null, following: true, open: true, floor: "", floors: [], bounds: null, bare: false, ready: false, fitted: false, touched: false, picked: false, extended: true };
const isPhone = () => window.innerWidth <= NARROW;
const panel = new Panel((walker) => {
  state.picked = true;
  state.open = walker !== state.chosen || !state.open;
  choose(walker);
});
let numbered = 0;

// The view
const padding = () => {
  const box = here("panel").getBoundingClientRect();
  if (!isPhone()) return { top: 20, bottom: 40, left: box.right + 20, right: 76 };
  document.documentElement.style.setProperty("--sheet", `${box.height}px`);
  return { top: 20, bottom: box.height + 24, left: 16, right: 68 };
};
const fit = (box, animate = true) => {
  if (box && state.map) state.map.fitBounds(box, { padding: padding(), maxZoom: ALONE, animate, duration: 500, linear: true });
};
const everything = () => {
  const all = [...walkers.values()],
    live = all.filter((walker) => !walker.finished);
  const reached = (live.length ? live : all).flatMap((walker) => walker.positions());
  return boxOf([...reached, ...(state.bounds || [])]);
};
const follow = () => {
  const walker = state.chosen;
  if (!state.map || !state.following || !walker || !walker.at) return;
  if (!state.fitted) {
    state.fitted = true;
    if (state.bare) showGrid(state.map, walker.at);
    return fit(everything(), false);
  }
  const { x, y } = state.map.project(walker.at),
    { top, bottom, left, right } = padding(),
    { clientWidth: wide, clientHeight: high } = state.map.getContainer();
  const inside = x > left && x < wide - right && y > top && y < high - bottom;
  if (inside || state.map.isMoving()) return;
  const offset = [(left - right) / 2, (top - bottom) / 2];
  state.map.easeTo({ center: walker.at, offset, duration: 700, zoom: Math.max(state.map.getZoom(), 17) });
};
const setFollowing = (on) => {
  state.following = on;
  state.touched = state.touched || !on; // the view is the user's from now on
  here("follow").setAttribute("aria-pressed", on);
  if (on) follow();
};

// Drawing, once per frame at most
let waiting = false;
const draw = () => {
  waiting = false;
  const all = [...walkers.values()],
    now = performance.now();
  panel.show(all, state.chosen, state.open);
  for (const walker of all) {
    const { classList } = walker.parts.pin;
    classList.toggle("alone", all.length === 1);
    classList.toggle("stale", walker.finished || isStale(walker, now));
    classList.toggle("elsewhere", Boolean(state.floor && walker.pose.floor && walker.pose.floor !== state.floor));
  }
  if (!state.ready) return;
  if (state.extended) state.map.getSource("finalised").setData(collection(all.flatMap((walker) => walker.finalisedLines())));
  state.extended = false; // an hour of walk is long
  state.map.getSource("current").setData(collection(all.flatMap((walker) => walker.currentLines())));
  state.map.getSource("regions").setData(collection(all.flatMap((walker) => walker.regions())));
  follow();
};
const redraw = () => {
  if (waiting) return;
  waiting = true;
  if (document.hidden) setTimeout(draw, 200);
  else requestAnimationFrame(draw);
};

// Floors
const setFloor = (label) => {
  if (state.floor === label || !state.floors.includes(label)) return;
  state.floor = label;
  for (const button of here("floors").children) {
    const on = button.textContent === label;
    button.setAttribute("aria-checked", on);
    button.tabIndex = on ? 0 : -1;
  }
  if (state.ready) showFloor(state.map, label);
  redraw();
};
const nextFloor = (up) => setFloor(state.floors[state.floors.indexOf(state.floor) + up]);
const makeFloors = (labels) => {
  state.floors = labels;
  here("floors").hidden = labels.length < 2;
  if (labels.length < 2) return;
  const buttons = [...labels].reverse().map((label) => {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: label, title: `Floor ${label}` });
    button.setAttribute("role", "radio");
    button.addEventListener("click", () => setFloor(label));
    return button;
  });
  here("floors").replaceChildren(...buttons);
  setFloor(labels[0]);
};

// Walkers
const choose = (walker) => {
  state.chosen = walker;
  if (walker && walker.pose.floor) setFloor(walker.pose.floor);
  setFollowing(true);
  redraw();
};
const receive = (pose) => {
  let walker = walkers.get(pose.id);
  if (!walker) {
    walker = new Walker(numbered, walkerColour(numbered++), pose, pathOf(pose.id));
    walkers.set(pose.id, walker);
    speak(`${pose.name} is on the map`);
  } else if (walker.pose.state !== pose.state) speak(`${pose.name}: ${pose.state}`);
  const climbed = walker.pose.floor !== pose.floor;
  walker.update(pose, state.map);
  if (!state.chosen || (!state.picked && state.chosen.finished && !walker.finished)) choose(walker);
  if (walker === state.chosen && (climbed || !state.floor) && state.following && pose.floor) setFloor(pose.floor);
  redraw();
};
const forget = (id) => {
  const walker = walkers.get(id);
  if (!walker) return;
  walker.remove();
  walkers.delete(id);
  paths.delete(id);
  state.extended = true;
  if (walker === state.chosen) choose([...walkers.values()][0] || null);
  redraw();
};
const synchronise = async () => {
  const list = await fetched("walkers");
  const ids = list.map(({ id }) => id);
  for (const id of walkers.keys()) if (!ids.includes(id)) forget(id);
  for (const pose of list) if (!walkers.has(pose.id)) receive(pose);
  redraw();
};

const zoom = (levels) => {
  state.touched = true;
  if (state.map) state.map.zoomTo(state.map.getZoom() + levels);
};

// Keys
const KEYS = {
  f: () => setFollowing(!state.following),
  0: () => { setFollowing(false); fit(everything()); },
  "+": () => zoom(1),
  "=": () => zoom(1),
  "-": () => zoom(-1),
  PageUp: () => nextFloor(1),
  PageDown: () => nextFloor(-1),
};
const onKey = (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented || !state.map) return;
  const onMap = event.target === state.map.getCanvas();
  if (onMap && "+=-".includes(event.key)) return; // the map does it
  const radio = event.target.getAttribute && event.target.getAttribute("role") === "radio";
  if (radio && (event.key === "ArrowUp" || event.key === "ArrowDown")) {
    nextFloor(event.key === "ArrowUp" ? 1 : -1);
    here("floors").querySelector('[aria-checked="true"]').focus();
    return event.preventDefault();
  }
  const number = Number(event.key);
  if (number >= 1 && number <= walkers.size) {
    state.picked = true;
    return choose([...walkers.values()][number - 1]);
  }
  const act = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (act) {
    event.preventDefault();
    act();
  }
};

const refused = (error) =>
  error.status === 401 || error.status === 403
    ? "This server needs a token: open the address that pdr-graph serve printed."
    : "No answer from the server; trying again.";

const showHelp = (guarded) => {
  here("address").textContent = address("sensorlogger") + (guarded ? "?token=…" : "");
  here("guarded").hidden = !guarded;
  here("reach").hidden = !["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);
};

const loadPlan = async (map) => {
  const plan = await fetched("plan");
  const { floors = [], bounds } = plan.pdr_graph || {};
  if (bounds) state.bounds = [bounds.slice(0, 2), bounds.slice(2)];
  map.getSource("plan").setData(plan);
  makeFloors(floors);
  fit(everything(), false);
};

const begin = async () => {
  state.open = !isPhone();
  let settings = {};
  try {
    settings = await fetched("settings");
  } catch (error) {
    notice(refused(error));
  }
  showHelp(settings.guarded);
  const map = newMap("map", settings.tiles);
  state.map = map;
  if (map) {
    map.on("dragstart", () => setFollowing(false));
    map.on("zoomstart", ({ originalEvent }) => originalEvent && (state.touched = true));
    new ResizeObserver(() => state.following && !state.touched && fit(everything(), false)).observe(here("panel"));
    await new Promise((resolve) => map.once("style.load", resolve));
    state.ready = true;
    await loadPlan(map).catch((error) => notice(refused(error)));
    state.bare = !state.bounds && !settings.tiles;
  } else notice("This browser cannot draw the map (it has no WebGL); the list of walkers works.");
  here("closer").addEventListener("click", () => zoom(1));
  here("farther").addEventListener("click", () => zoom(-1));
  here("follow").addEventListener("click", () => setFollowing(!state.following));
  here("everything").addEventListener("click", KEYS[0]);
  document.addEventListener("keydown", onKey);
  listen(
    {
      pose: receive,
      path: (event) => {
        const path = pathOf(event.id);
        if (!path.finalised.length && event.finalised.time.length) state.fitted = false; // show where it came from
        path.extend(event);
        state.extended = true;
        redraw();
      },
      forgotten: ({ id }) => forget(id),
    },
    (on) => {
      if (on) {
        if (map) notice("");
        return synchronise().catch((error) => notice(refused(error)));
      }
      return fetched("settings").then(
        () => notice("The stream of events broke off; trying again."),
        (error) => notice(refused(error)),
      );
    },
  );
  setInterval(() => document.hidden || redraw(), NAMES);
  document.documentElement.dataset.ready = "yes";
};

window.page = { state, walkers }; // for tests, and for the curious
begin();
