// The map: tiles if there are any, the plan, the paths and regions of the walkers.

import { collection, gridAbout } from "./geo.js";
import { colours, whenChanged } from "./colours.js";

const CLOSEST = 23; // zoom level
const EXACT = { type: "geojson", maxzoom: 20, tolerance: 0.2, data: collection([]) }; // a corridor is 2 m wide

const ofLayer = (name) => ["==", ["get", "layer"], name];
const width = (metres, least) => [
  // a width in metres, but no less than some pixels
  ...["interpolate", ["exponential", 2], ["zoom"]],
  ...[15, least, 19, Math.max(least, metres / 0.3), 23, Math.max(least, metres / 0.019)],
];
const fill = (name) => ({ id: name, type: "fill", source: "plan", filter: ofLayer(name) });
const line = (name, metres) => ({
  id: name, type: "line", source: "plan", filter: ofLayer(name), paint: { "line-width": width(metres, 1) },
});
const pathLine = (id, source, part, paint) => ({
  id, type: "line", source, ...(part ? { filter: ["==", ["get", "part"], part] } : {}),
  layout: { "line-cap": "round", "line-join": "round" },
  paint: { "line-color": ["get", "colour"], ...paint },
});

const LAYERS = [
  { id: "grid", type: "line", source: "grid", paint: { "line-width": 1, "line-opacity": 0.6 } },
  ...["ground", "walkable", "room", "door", "stairs"].map(fill),
  line("border", 0.05),
  { ...line("link", 0.05), layout: {} },
  line("wall", 0.12),
  {
    id: "beacon", type: "circle", source: "plan", filter: ofLayer("beacon"),
    paint: { "circle-radius": 3, "circle-color": "#8257e5", "circle-opacity": 0.6 },
  },
  {
    id: "name", type: "symbol", source: "plan", filter: ofLayer("name"), minzoom: 17.5,
    layout: { "text-field": ["get", "text"], "text-size": 12, "text-font": ["system-ui", "sans-serif"], "text-max-width": 7 },
    paint: { "text-halo-width": 1.2 },
  },
  {
    id: "region", type: "fill", source: "regions",
    paint: { "fill-color": ["get", "colour"], "fill-opacity": ["*", 0.16, ["get", "weight"]] },
  },
  {
    id: "region-edge", type: "line", source: "regions",
    paint: { "line-color": ["get", "colour"], "line-opacity": ["*", 0.55, ["get", "weight"]], "line-width": 1.2 },
  },
  pathLine("path-case", "finalised", "", { "line-color": "#ffffff", "line-width": 6, "line-opacity": 0.75 }),
  pathLine("finalised", "finalised", "", { "line-width": 3.2 }),
  pathLine("current", "current", "current", { "line-width": 3.2, "line-opacity": 0.68 }),
  pathLine("tail", "current", "tail", { "line-width": 3.2, "line-opacity": 0.6, "line-dasharray": [0.3, 1.8] }),
];
const LETTERED = ["name"];

const style = (tiles) => {
  const background = { id: "outside", type: "background", paint: {} };
  const raster = { id: "tiles", type: "raster", source: "tiles" };
  const sources = { plan: EXACT, finalised: EXACT, current: EXACT, regions: EXACT, grid: EXACT };
  if (tiles) sources.tiles = { type: "raster", tiles: [tiles.url], tileSize: 256, maxzoom: 19, attribution: tiles.attribution };
  return { version: 8, sources, layers: [background, ...(tiles ? [raster] : []), ...LAYERS] };
};

const paint = (map) => {
  const now = colours();
  map.setPaintProperty("outside", "background-color", now.outside);
  for (const { id, type, source } of LAYERS) {
    if ((source !== "plan" && source !== "grid") || !(id in now)) continue;
    map.setPaintProperty(id, LETTERED.includes(id) ? "text-color" : `${type}-color`, now[id]);
  }
  map.setPaintProperty("name", "text-halo-color", now.halo);
  map.setPaintProperty("path-case", "line-color", now.halo);
};

// The map in an element; null where the browser cannot draw one. tiles: null or url and attribution.
export const newMap = (container, tiles) => {
  maplibregl.setWorkerUrl(new URL("maplibre-gl/maplibre-gl-csp-worker.js", import.meta.url).href);
  let map;
  try {
    map = new maplibregl.Map({
      container, style: style(tiles), center: [0, 0], zoom: 1, maxZoom: CLOSEST, maxPitch: 0, fadeDuration: 0,
      dragRotate: false, pitchWithRotate: false, attributionControl: tiles ? { compact: true } : false,
      canvasContextAttributes: { antialias: true },
    });
  } catch {
    return null;
  }
  map.touchZoomRotate.disableRotation();
  map.keyboard.disableRotation();
  map.addControl(new maplibregl.ScaleControl({ maxWidth: 90 }), "bottom-left");
  map.once("style.load", () => paint(map));
  whenChanged(() => paint(map));
  return map;
};

// Draw lines every 10 m about a place, where there is nothing else to see.
export const showGrid = (map, place) => map.getSource("grid").setData(gridAbout(place));

// Show the plan, paths and regions of one floor; empty: of all.
export const showFloor = (map, floor) => {
  const here = floor ? ["in", ["get", "floor"], ["literal", [floor, ""]]] : true;
  for (const { id, filter, source } of LAYERS) if (source !== "grid") map.setFilter(id, floor ? ["all", here, ...(filter ? [filter] : [])] : filter || null);
};
