// Pose of the walker at a time, and its markers.

const ARROW = [[13, 0], [-8, 8], [-4, 0], [-8, -8]]; // [px] forward and left
const CHI = Math.sqrt(5.99); // of the 95 % ellipse
const TRAIL = 60; // [s] length of the walker's trail, at most a twentieth of the walk

const walkers = content.tracks.filter((track) => track.walker).reverse(); // the result first
let time = content.start; // shown now

const at = (track, when) => {
  const times = track.time;
  if (!times.length || when < times[0] - 1e-6 || when > times[times.length - 1] + 1e-6) return null;
  let low = 0,
    high = times.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= when) low = middle;
    else high = middle;
  }
  const share =
    times[high] > times[low] ? Math.min(Math.max((when - times[low]) / (times[high] - times[low]), 0), 1) : 0;
  const between = (values) => values[low] + share * (values[high] - values[low]);
  const near = share < 0.5 ? low : high,
    x = between(track.x),
    y = between(track.y);
  if (!Number.isFinite(x)) return null;
  return {
    x,
    y,
    on: track.on[near],
    heading: track.heading[near],
    covariance: track.covariance && track.covariance.map(between),
  };
};
const ring = ({ x, y, covariance: [xx, xy, yy] }) => {
  const middle = (xx + yy) / 2,
    apart = Math.hypot((xx - yy) / 2, xy),
    angle = Math.atan2(2 * xy, xx - yy) / 2;
  const long = CHI * Math.sqrt(middle + apart),
    short = CHI * Math.sqrt(Math.max(middle - apart, 0)),
    points = [];
  for (let n = 0; n < 40; n++) {
    const a = Math.cos((n * Math.PI) / 20) * long,
      b = Math.sin((n * Math.PI) / 20) * short;
    points.push(`${x + a * Math.cos(angle) - b * Math.sin(angle)},${y + a * Math.sin(angle) + b * Math.cos(angle)}`);
  }
  return `M${points.join("L")}Z`;
};
const arrow = (heading) =>
  ARROW.map(
    ([a, b]) => `${a * Math.cos(heading) - b * Math.sin(heading)},${a * Math.sin(heading) + b * Math.cos(heading)}`,
  );
const shapesOf = (track) => {
  const pose = at(track, time);
  if (!pose || !onMap(pose.on)) return [];
  const pinned = {
    xsizemode: "pixel",
    ysizemode: "pixel",
    xanchor: pose.x,
    yanchor: pose.y,
    xref: "x",
    yref: "y",
    line: { color: "#fff", width: 1.5 },
    fillcolor: track.colour,
  };
  const region =
    track.lead && pose.covariance
      ? [
          {
            type: "path",
            path: ring(pose),
            name: "region",
            line: { color: track.colour, width: 1 },
            fillcolor: pale(track.colour, 0.25),
          },
        ]
      : [];
  const pointed = track.lead && Number.isFinite(pose.heading);
  return [
    ...region,
    {
      ...pinned,
      name: track.lead ? "walker" : track.name,
      ...(pointed
        ? { type: "path", path: `M${arrow(pose.heading).join("L")}Z` }
        : { type: "circle", x0: -6, x1: 6, y0: -6, y1: 6 }),
    },
  ];
};
const trailOf = (track) => {
  // the latest part of the track
  const points = track.time
    .map((_, n) => n)
    .filter(
      (n) =>
        track.time[n] <= time &&
        track.time[n] > time - Math.min(TRAIL, (content.end - content.start) / 20) &&
        onMap(track.on[n]) &&
        Number.isFinite(track.x[n]),
    );
  const pose = at(track, time),
    ends = [
      ...points.map((n) => `${track.x[n]},${track.y[n]}`),
      ...(pose && onMap(pose.on) ? [`${pose.x},${pose.y}`] : []),
    ];
  const style = { type: "path", path: `M${ends.join("L")}`, fillcolor: "#0000", xref: "x", yref: "y" };
  return ends.length > 1
    ? [
        { ...style, name: "trail", line: { color: "#fff", width: 6 } },
        { ...style, name: "trail", line: { color: track.colour, width: 3.5 } },
      ]
    : [];
};
const walkerShapes = () => [
  ...walkers.filter((track) => track.lead).flatMap(trailOf),
  ...[...walkers].reverse().flatMap(shapesOf),
];
