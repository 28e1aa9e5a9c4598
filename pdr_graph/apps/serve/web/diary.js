// The map of a day in the diary: its legs, and a button for each place; both open the forms that correct a row.

import { boxOf, collection } from "./geo.js";
import { newMap } from "./map.js";

const CLOSEST = 17; // zoom level of a day at one place
const MARGIN = { top: 48, bottom: 48, left: 32, right: 84 }; // [px] around the day, for names on the right
const here = (id) => document.getElementById(id);
const element = here("map");

// Show the forms of a row under the map. marker: of a stay, which can be dragged to where the person was; stays: all
// at its place, each of which a button opens.
const open = async (shown, row, marker, stays = []) => {
  const answer = await fetch(`entry?${shown.query}&n=${row.n}`);
  const page = new DOMParser().parseFromString(await answer.text(), "text/html");
  const title = Object.assign(document.createElement("h2"), { textContent: page.querySelector("h1").textContent, tabIndex: -1 });
  const forms = [...page.querySelectorAll("form, .fault")];
  const others = stays.filter((stay) => stays.length > 1 && stay !== row).map((stay) => {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: stay.time });
    button.addEventListener("click", () => open(shown, stay, marker, stays));
    return button;
  });
  here("forms").replaceChildren(title, ...others, ...forms);
  here("forms").hidden = false;
  title.focus();
  const moved = forms.find((form) => form.elements.do?.value === "at");
  if (!marker || !moved) return;
  moved.append(Object.assign(document.createElement("small"), { textContent: " or drag the stay on the map" }));
  marker.setDraggable(true).on("dragend", () => {
    const { lng, lat } = marker.getLngLat();
    moved.elements.value.value = `${lat.toFixed(6)},${lng.toFixed(6)}`;
    moved.querySelector("button").focus();
  });
};

const placeButton = (map, shown, stays) => {
  const button = Object.assign(document.createElement("button"), { className: "stay", type: "button" });
  const times = stays.map((stay) => stay.time).join(", ");
  button.append(Object.assign(document.createElement("span"), { textContent: stays[0].label || times }));
  const marker = new maplibregl.Marker({ element: button }).setLngLat(stays[0].at).addTo(map);
  button.title = `${stays[0].label} ${times}`.trim();
  button.setAttribute("aria-label", button.title);
  button.addEventListener("click", (event) => {
    event.stopPropagation(); // a leg below it stays closed
    document.querySelector(".stay[aria-pressed]")?.removeAttribute("aria-pressed");
    button.setAttribute("aria-pressed", "true");
    open(shown, stays[0], marker, stays);
  });
};

const start = async () => {
  const answer = await fetch(element.dataset.from);
  if (!answer.ok) return element.remove();
  const shown = await answer.json();
  const box = boxOf([...shown.stays.map((row) => row.at), ...shown.legs.flatMap((leg) => leg.geometry.coordinates)]);
  const map = box && newMap(element, shown.tiles);
  if (!map) return element.remove(); // no WebGL, or nothing on earth: the picture shows the day
  const fit = () => map.fitBounds(box, { padding: MARGIN, maxZoom: CLOSEST, animate: false });
  map.addControl(new maplibregl.NavigationControl({ showCompass: false }), "top-right");
  await new Promise((loaded) => map.once("load", loaded));
  map.getSource("plan").setData(shown.plan);
  map.getSource("finalised").setData(collection(shown.legs));
  fit();
  new ResizeObserver(fit).observe(element);
  Object.values(Object.groupBy(shown.stays, (stay) => stay.place)).forEach((stays) => placeButton(map, shown, stays));
  map.on("click", "finalised", ({ features }) => open(shown, features[0].properties, null));
  map.on("mouseenter", "finalised", () => (map.getCanvas().style.cursor = "pointer"));
  map.on("mouseleave", "finalised", () => (map.getCanvas().style.cursor = ""));
  element.dataset.drawn = "yes";
};
if (element) start();
