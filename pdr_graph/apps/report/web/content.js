// The content of the page: its format, decoding of its numbers, formatting of its times.
//
//   verdict: null or state and reasons, each with text and check; title, subtitle; headline: [name, value]; missing, warnings (the
//   heaviest first), notes: lines; start, end: of the slider
//   maps: name, corners, plan: null or svg with its corners and the names in it; north: true if y points there
//   tracks: name, colour, on, time, x, y, heading, covariance (xx, xy, yy), bands (rings per map), width, dash, mode,
//     symbol, gaps: [from, to] of times without data; walker: true if a marker moves along it; lead: true if the marker has a direction, a region and a trail
//   marks: name, colour, symbol, on, x, y, text; time, weight, heading, and to_x, to_y: where a line leads from each
//   charts: title, unit, height [px], from_zero, logarithmic, labels of whole numbers, lines: name, colour, time, y;
//     low, high, mode, shape, width, weight, text
//   phases: start, end, text: shown beside the clock during this time
//   tables: title, note: a line above it, open, head, rows; moments: the time of each row
//
// A column of numbers is {unit, steps}: differences between consecutive values in units, null for an unknown value. `on` is
// the number of the map of each row, run-length encoded as [number, count]; -1: on every map, -2: on none.

const EVERYWHERE = -1;
const STEPS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400]; // [s] between ticks
const TICKS = 7;

const content = JSON.parse(document.getElementById("content").textContent);
const here = (id) => document.getElementById(id);

// Decoding
const numbers = ({ unit, steps }) => {
  let sum = 0;
  return steps.map((step) => (step === null ? NaN : (sum += step) * unit));
};
const unrolled = (runs) => runs.flatMap(([value, count]) => Array(count).fill(value));
const plain = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;").replace(/\n/g, "<br>");
const each = (items, columns) => {
  for (const item of items) for (const name of columns) if (item[name]) item[name] = numbers(item[name]);
};
each(content.tracks, ["time", "x", "y", "heading"]);
each(content.marks, ["time", "x", "y", "to_x", "to_y", "weight", "heading"]);
each(
  content.charts.flatMap((chart) => chart.lines),
  ["time", "y", "low", "high", "weight"],
);
for (const track of content.tracks) {
  track.on = unrolled(track.on);
  track.covariance = track.covariance && track.covariance.map(numbers);
  each((track.bands || []).filter(Boolean), ["x", "y"]);
}
for (const mark of content.marks) mark.on = unrolled(mark.on);

// Formatting of times
const two = (number) => String(number).padStart(2, "0");
const clock = (time) => {
  const whole = Math.round(Math.abs(time)),
    hours = Math.floor(whole / 3600),
    rest = `${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}`;
  return (time < -0.5 ? "-" : "") + (hours ? `${hours}:${rest}` : rest.replace(/^0/, ""));
};
const ticks = (start, end) => {
  const step = STEPS.find((seconds) => (end - start) / seconds <= TICKS) || STEPS[STEPS.length - 1];
  const values = [];
  for (let time = Math.ceil(start / step) * step; time <= end; time += step) values.push(time);
  return { tickvals: values, ticktext: values.map(clock) };
};
