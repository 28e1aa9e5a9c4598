// Draw the page: the map first, since users look at it first.

const unpacked = (text) => {
  // the library lies in the page compressed
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).text();
};
const library = () =>
  unpacked(here("library").textContent).then((text) => document.head.append(element("script", text)));

write();
document.documentElement.style.setProperty("--top", `${here("map").getBoundingClientRect().top + scrollY}px`);
here("north").hidden = !content.north;
Object.assign(slider, { min: content.start, max: content.end, step: "any", value: content.start });
slider.addEventListener("input", () => {
  if (playing !== null) pause();
  show(slider.valueAsNumber, slider);
});
here("play").addEventListener("click", () => (playing === null ? play() : pause()));

const STEPS_BY_KEY = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -20, PageUp: 20 };
const whole = () => {
  // all of the map and of the charts again
  const [[west, south], [east, north]] = content.maps.length ? content.maps[shown].corners : [[], []];
  if (map.layout) Plotly.relayout(map, { "xaxis.range": [west, east], "yaxis.range": [south, north] });
  if (charts.layout) Plotly.relayout(charts, { "xaxis.range": rangeOfCharts() });
};
document.addEventListener("keydown", (event) => {
  const by = STEPS_BY_KEY[event.key],
    elsewhere = event.ctrlKey || event.altKey || event.metaKey || event.target.matches(".scroll"),
    vertical = /Up|Down/.test(event.key) && event.target !== slider; // scrolls the page
  if (elsewhere) return;
  if (by && !vertical) show(time + by * Math.max(1, (content.end - content.start) / 200));
  else if (event.key === " " && !event.target.matches("button, summary")) playing === null ? play() : pause();
  else if (event.key === "Escape") whole();
  else return;
  event.preventDefault();
});

const themed = (next) => {
  theme = next;
  if (map.layout) drawMap();
  if (charts.layout) drawCharts();
};
const PRINTED = { map: { width: 680, height: 560 }, charts: { width: 680, height: Math.min(heightOfCharts(), 980) } }; // [px] on A4
const printing = (on) => {
  themed(on || !night.matches ? LIGHT : DARK);
  for (const [name, size] of Object.entries(PRINTED))
    if (here(name) && here(name).layout)
      Plotly.relayout(here(name), on ? size : { width: undefined, height: name === "map" ? undefined : heightOfCharts() });
};
night.addEventListener("change", () => themed(night.matches ? DARK : LIGHT));
addEventListener("beforeprint", () => printing(true));
addEventListener("afterprint", () => printing(false));

const begun = () => {
  // a day without positions has no map
  if (!content.maps.length) {
    here("place").remove();
    return Promise.resolve();
  }
  return choose(follows());
};
library()
  .then(begun)
  .then(() => {
    performance.mark("picture");
    const clicked = ({ points }) => {
      const [point] = points;
      if (Number.isFinite(point.customdata)) jump(point.customdata);
    };
    if (map.layout) {
      map.on("plotly_click", clicked);
      map.on("plotly_relayout", (change) => {
        if (!("shapes" in change)) renamed();
      });
    }
    moved();
    tabulate();
    return content.charts.length
      ? drawCharts().then(() => {
          charts.on("plotly_click", clicked);
          charts.on("plotly_relayout", (change) => {
            if (Object.keys(change).some((name) => /^xaxis\.(range|autorange)/.test(name))) {
              const { tickvals, ticktext } = ticks(...charts.layout.xaxis.range);
              Plotly.relayout(charts, { "xaxis.tickvals": tickvals, "xaxis.ticktext": ticktext });
            }
          });
        })
      : here("charts").remove();
  })
  .then(() => performance.mark("whole"));
