// The time shown: slider, clock and playback.

const PLAYING = 40; // [s] duration of the playback of a whole walk

const slider = here("slider");

const describe = () => {
  const phase = (content.phases || []).find((one) => one.start <= time && time <= one.end);
  const pose = walkers.length ? at(walkers[0], time) : null; // of the result
  const floor =
    pose && content.maps.length > 1 && pose.on >= 0 && !content.phases ? `floor ${content.maps[pose.on].name}, ` : "";
  return phase ? phase.text : pose ? `${floor}${placeOf(pose)}` : "";
};
let asked = false;
const moved = () => {
  asked = false;
  here("clock").textContent = clock(time);
  here("readout").textContent = describe();
  slider.setAttribute("aria-valuetext", `${clock(time)} ${describe()}`);
  const next = follows();
  if (next !== shown) choose(next);
  else if (map.layout)
    Plotly.relayout(map, { shapes: walkerShapes(), ...following(walkers.length ? at(walkers[0], time) : null) });
  if (charts.layout) Plotly.relayout(charts, { "shapes[0].x0": time, "shapes[0].x1": time });
};
const show = (when, from) => {
  time = Math.min(Math.max(when, content.start), content.end);
  if (from !== slider) slider.value = time;
  if (!asked) {
    asked = true;
    requestAnimationFrame(moved);
  }
};

const jump = (when) => {
  // to a moment that was clicked, with the map in sight
  show(when);
  if (map.layout) here("place").scrollIntoView({ block: "nearest" });
};

// Playback of all in PLAYING seconds, of a short walk in real time
let playing = null;
const speed = Math.max(1, (content.end - content.start) / PLAYING);
const frame = (before) => (now) => {
  if (playing === null) return;
  show(time + (speed * (now - before)) / 1000);
  if (time >= content.end) pause();
  else playing = requestAnimationFrame(frame(now));
};
const button = (sign, name) => {
  here("play").textContent = sign;
  here("play").setAttribute("aria-label", name);
};
const pause = () => {
  cancelAnimationFrame(playing);
  playing = null;
  button("▶", "Play");
};
const play = () => {
  if (time >= content.end) show(content.start);
  button("⏸", "Pause");
  playing = requestAnimationFrame(frame(performance.now()));
};
