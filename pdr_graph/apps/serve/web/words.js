// The state of a walk in words.

export const HINTS = {
  waiting: "waiting for sensors and a first position",
  "fixes alone": "positions, no steps",
  "no absolute position": "the shape of the walk; its place is not known",
  "initialising heading": "walk on: the direction is not known yet",
  running: "",
  finished: "the recording has ended",
};
const COMPASS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];
const SURE = 1.0; // [rad] standard deviation of the heading up to which it is shown
const OLD = 5; // [s] without a message after which a walker is stale

export const accuracy = (sigma) => (sigma === null ? "" : sigma < 9.95 ? `± ${sigma.toFixed(1)} m` : `± ${Math.round(sigma)} m`);
export const direction = (bearing) => COMPASS[Math.round(bearing / 45) % 8];
export const duration = (seconds) => {
  if (seconds < 90) return `${Math.round(seconds)} s`;
  return seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
};
export const isStale = (walker, now) => walker.pose.state !== "finished" && now - walker.heard > 1000 * OLD;

// One line: the state, and since when nothing was received; the number of issues unless they are listed below.
export const stateLine = (walker, now, listed) => {
  const { state, floor, issues } = walker.pose;
  if (isStale(walker, now)) return `no data for ${duration((now - walker.heard) / 1000)}`;
  const counted = issues.length === 1 ? issues[0].split(":")[0] : `${issues.length} issues`;
  return [state, ...(floor ? [`floor ${floor}`] : []), ...(issues.length && !listed ? [`▲ ${counted}`] : [])].join(" · ");
};

export const isDirected = (pose) =>
  pose.state !== "initialising heading" && pose.heading_sigma !== null && pose.heading_sigma < SURE;
