// The map: plan, tracks, marks and the walker.

const LETTER = 6; // [px] width of a letter of a name
const MANY = 50; // marks above which they are drawn small and below the track
const OUTSIDE = "#efece6";
const LIGHT = { ink: "#26241f", soft: "#6b655b", line: "#e4e0d8", card: "#ffffff", map: "#ffffff" };
const DARK = { ink: "#e8e4dc", soft: "#a8a196", line: "#3d3a34", card: "#201e1a" };
const night = matchMedia("(prefers-color-scheme: dark)");
let theme = night.matches ? DARK : LIGHT;
const font = ({ ink } = theme) => ({ family: "system-ui, sans-serif", size: 12, color: ink });
const CONFIG = {
  // privacy: no button that uploads the track to the makers of the library
  displaylogo: false,
  responsive: true,
  scrollZoom: true,
  modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"],
  showSendToCloud: false,
  plotlyServerURL: "",
  displayModeBar: window.innerWidth >= 600,
};

const map = here("map");
let shown = 0; // number of the map shown
const onMap = (on) => on === shown || on === EVERYWHERE;
const kept = (item, column) => item[column].map((value, n) => (onMap(item.on[n]) ? value : NaN));
const pale = (colour, share) =>
  colour +
  Math.round(255 * share)
    .toString(16)
    .padStart(2, "0");

const bandOf = (track) => ({
  type: "scatter",
  mode: "lines",
  ...track.bands[shown],
  fill: "toself",
  fillcolor: pale(track.colour, 0.2),
  line: { width: 0 },
  hoverinfo: "skip",
  name: "95 % region",
  showlegend: track.bands[shown].x.length > 0,
});
const placeOf = ({ x, y, heading, covariance }) => {
  const sigma = covariance ? ` ± ${Math.sqrt((covariance[0] + covariance[2]) / 2).toFixed(1)}` : "";
  const bearing = (((90 - (heading * 180) / Math.PI) % 360) + 360) % 360; // clockwise
  const turned = Number.isFinite(heading)
    ? `, heading ${Math.round(bearing) % 360}° from ${content.north ? "north" : "+y"}`
    : "";
  return `x ${x.toFixed(1)}, y ${y.toFixed(1)}${sigma} m${turned}`;
};
const poseOf = (track, n) => ({
  x: track.x[n],
  y: track.y[n],
  heading: track.heading[n],
  covariance: track.covariance && track.covariance.map((values) => values[n]),
});
const inGap = (track, n) =>
  (track.gaps || []).some(([from, to]) => track.time[n] > from - 0.02 && track.time[n + 1] < to + 0.02);
const lineOf = (track) => {
  const x = kept(track, "x"),
    y = kept(track, "y"),
    rows = track.time.map((_, n) => n).filter((n) => inGap(track, n));
  const broken = (values, none) => values.flatMap((value, n) => (rows.includes(n) ? [value, none] : [value]));
  const whole = {
    type: "scatter",
    mode: track.mode || "lines",
    x: rows.length ? broken(x, NaN) : x,
    y: rows.length ? broken(y, NaN) : y,
    name: plain(track.name),
    line: { color: track.colour, width: track.width, dash: track.dash },
    showlegend: track.on.some(onMap),
    marker: { color: track.colour, size: 9, symbol: track.symbol, line: { color: track.colour, width: 2 } },
    text: broken(
      track.time.map((at, n) => `${plain(track.name)} ${clock(at)}<br>${placeOf(poseOf(track, n))}`),
      "",
    ),
    hoverinfo: "text",
    customdata: broken(track.time, null),
  };
  const ends = (values) => rows.flatMap((n) => [values[n], values[n + 1], NaN]);
  const unseen = {
    ...{ type: "scatter", mode: "lines", x: ends(x), y: ends(y), name: "no data", hoverinfo: "skip" },
    line: { color: track.colour, width: track.width, dash: "dash" },
  };
  return rows.length ? [whole, unseen] : [whole];
};
const weighted = (item, size) => ({
  symbol: item.symbol,
  size,
  color: item.weight ? item.weight.map((weight) => pale(item.colour, 0.12 + 0.88 * weight)) : item.colour,
  line: { color: item.colour, width: 1.3 },
  ...(item.heading ? { angle: item.heading.map((heading) => 90 - (heading * 180) / Math.PI) } : {}),
});
const tiesOf = (mark) => ({
  type: "scatter",
  mode: "lines",
  x: mark.x.flatMap((x, n) => (onMap(mark.on[n]) ? [x, mark.to_x[n], NaN] : [])),
  y: mark.y.flatMap((y, n) => (onMap(mark.on[n]) ? [y, mark.to_y[n], NaN] : [])),
  hoverinfo: "skip",
  showlegend: false,
  line: { color: pale(mark.colour, 0.5), width: 1 },
  legendgroup: mark.name,
});
const marksOf = (mark) => ({
  type: "scatter",
  mode: "markers",
  x: kept(mark, "x"),
  y: kept(mark, "y"),
  name: plain(mark.name),
  legendgroup: mark.name,
  text: mark.text.map((text, n) => (mark.time ? `${clock(mark.time[n])}<br>` : "") + plain(text)),
  hoverinfo: "text",
  marker: weighted(mark, mark.size || (mark.x.length > MANY ? 5 : 9)),
  customdata: mark.time,
  showlegend: mark.on.some(onMap),
});
const namesOf = ({ plan }, fit) => {
  const names = plan ? plan.names.filter((name) => name.text.length * LETTER < name.width * fit) : [];
  return {
    type: "scatter",
    mode: "text",
    x: names.map((name) => name.x),
    y: names.map((name) => name.y),
    hoverinfo: "skip",
    showlegend: false,
    text: names.map((name) => plain(name.text)),
    textfont: { size: 10, color: LIGHT.soft },
  };
};
const perMetre = () => {
  // [px]
  const axis = map._fullLayout && map._fullLayout.xaxis;
  return axis ? axis._length / Math.abs(axis.range[1] - axis.range[0]) : 0;
};
const picture = ({ plan }) => {
  if (!plan) return [];
  const [[west, south], [east, north]] = plan.corners;
  return [
    {
      source: `data:image/svg+xml,${encodeURIComponent(plan.svg)}`,
      xref: "x",
      yref: "y",
      x: west,
      y: north,
      sizex: east - west,
      sizey: north - south,
      sizing: "stretch",
      layer: "below",
    },
  ];
};
const LENGTHS = [
  // 2,500m, and 12km where ticks are a kilometre apart or more
  { dtickrange: [null, 999], value: ",.10~r" }, // all digits of UTM's northings
  { dtickrange: [999, null], value: "~s" },
];
const drawMap = () => {
  const own = content.maps[shown],
    [[west, south], [east, north]] = own.corners;
  const style = { zeroline: false, gridcolor: LIGHT.line, ticks: "", tickfont: { color: LIGHT.soft, size: 11 } };
  const axis = { ...style, uirevision: shown, ticksuffix: "m", tickformatstops: LENGTHS, automargin: true };
  // in the colours of the plan; on a dark page the style turns all of it around
  const layout = {
    font: font(LIGHT),
    margin: { l: 40, r: 8, t: 30, b: 24 },
    paper_bgcolor: LIGHT.card,
    plot_bgcolor: own.plan ? OUTSIDE : LIGHT.map,
    dragmode: "pan",
    hovermode: "closest",
    xaxis: { ...axis, range: [west, east], nticks: 6, showgrid: !own.plan },
    yaxis: { ...axis, range: [south, north], scaleanchor: "x", nticks: 8, showgrid: !own.plan },
    legend: {
      orientation: "h",
      y: 1.01,
      yanchor: "bottom",
      font: { size: 11, color: LIGHT.ink },
      bgcolor: LIGHT.card,
    },
    images: picture(own),
    shapes: walkerShapes(),
    uirevision: "always",
    hoverlabel: { bgcolor: LIGHT.card, font: font(LIGHT), align: "left" },
    modebar: { orientation: "v", bgcolor: pale(LIGHT.card, 0.7), color: LIGHT.soft, activecolor: LIGHT.ink },
  };
  const banded = content.tracks.filter((track) => track.bands && track.bands[shown]).map(bandOf),
    tied = content.marks.filter((mark) => mark.to_x).map(tiesOf),
    many = (mark) => mark.x.length > MANY;
  const data = [
    namesOf(own, perMetre()),
    ...banded,
    ...tied,
    ...content.marks.filter(many).map(marksOf),
    ...content.tracks.filter((track) => track.width !== 0).flatMap(lineOf),
    ...content.marks.filter((mark) => !many(mark)).map(marksOf),
  ];
  here("hint").textContent = beyond(own);
  return Plotly.react(map, data, layout, CONFIG).then(measured);
};
const beyond = ({ corners: [[west, south], [east, north]] }) => {
  const outside = (item) =>
    item.x.some((x, n) => onMap(item.on[n]) && (x < west || x > east || item.y[n] < south || item.y[n] > north));
  const names = [...content.tracks.filter((track) => track.width !== 0), ...content.marks].filter(outside);
  return names.length ? `beyond this picture, zoom out: ${names.map(({ name }) => name).join(", ")}` : "";
};
const measured = () => {
  // the scale bar: the longest of 1, 2, 5, 10 … m that is not above a sixth of the map
  const most = (map.clientWidth || 600) / 6 / (perMetre() || 1),
    power = 10 ** Math.floor(Math.log10(most)),
    length = power * [5, 2, 1].find((times) => times * power <= most);
  here("bar").style.width = `${length * perMetre()}px`;
  here("length").textContent = length < 1000 ? `${+length.toPrecision(1)} m` : `${length / 1000} km`;
};
const WITHIN = 0.04; // share of the map, from its border, that the walker does not enter
const following = (pose) => {
  // the ranges of the map that bring the walker back into sight
  if (!pose || !onMap(pose.on)) return {};
  const moved = ([low, high], value) => {
    const edge = WITHIN * (high - low);
    return value < low + edge || value > high - edge ? [low, high].map((end) => end + value - (low + high) / 2) : null;
  };
  const x = moved(map.layout.xaxis.range, pose.x),
    y = moved(map.layout.yaxis.range, pose.y);
  return { ...(x ? { "xaxis.range": x } : {}), ...(y ? { "yaxis.range": y } : {}) };
};
const renamed = () => {
  // after zooming, other names fit
  measured();
  const names = namesOf(content.maps[shown], perMetre());
  if (content.maps[shown].plan && names.text.join() !== map.data[0].text.join())
    Plotly.restyle(map, { x: [names.x], y: [names.y], text: [names.text] }, [0]);
};
const choose = (number) => {
  shown = number;
  here("chooser")
    .querySelectorAll("button")
    .forEach((button, n) => button.setAttribute("aria-pressed", n === shown));
  return drawMap().then(renamed);
};
const follows = () => {
  // number of the map with the walker on it, preferably the map shown
  const inside = (pose, { corners: [low, high] }) =>
    pose.x >= low[0] && pose.x <= high[0] && pose.y >= low[1] && pose.y <= high[1];
  const shows = (number) =>
    walkers.some((track) => {
      const pose = at(track, time);
      return (
        pose &&
        (pose.on === number || (pose.on === EVERYWHERE && number === shown)) &&
        inside(pose, content.maps[number])
      );
    });
  if (shows(shown)) return shown;
  const others = content.maps.map((_, number) => number).filter(shows);
  return others.length ? others[others.length - 1] : shown;
};
