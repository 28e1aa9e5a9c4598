// Draw the page: the map first, since users look at it first.

write();
Object.assign(slider, { min: content.start, max: content.end, step: "any", value: content.start });
slider.addEventListener("input", () => {
  if (playing !== null) pause();
  show(slider.valueAsNumber, slider);
});
slider.addEventListener("keydown", (event) => {
  // keyboard steps: the slider itself is continuous
  const by = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -20, PageUp: 20 }[event.key];
  if (by) {
    event.preventDefault();
    show(time + by * Math.max(1, (content.end - content.start) / 200));
  }
});
here("play").addEventListener("click", () => (playing === null ? play() : pause()));

const begun = () => {
  // a day without positions has no map
  if (!content.maps.length) {
    here("place").remove();
    return Promise.resolve();
  }
  return choose(follows());
};
begun()
  .then(() => {
    performance.mark("picture");
    const clicked = ({ points }) => {
      const [point] = points;
      if (Number.isFinite(point.customdata)) show(point.customdata);
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
