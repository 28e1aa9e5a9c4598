// Colours of the map in both themes, and of the walkers: distinguishable by the colour-blind, on light and dark.

const dark = matchMedia("(prefers-color-scheme: dark)");
const LIGHT = {
  outside: "#eceef1", grid: "#d5d9df", ground: "#d3d7dd", walkable: "#ffffff", room: "#f3f5f7", door: "#e8cfa9", stairs: "#e9e4cd",
  wall: "#868d97", border: "#b4bac3", link: "#c3c8cf", name: "#6a717b", halo: "#ffffff",
};
const DARK = {
  outside: "#101317", grid: "#252b33", ground: "#1a1e24", walkable: "#323842", room: "#2a3038", door: "#5a4a31", stairs: "#423f31",
  wall: "#6d7683", border: "#3c434d", link: "#454c57", name: "#98a1ad", halo: "#1b1f25",
};
const WALKERS = ["#1f6feb", "#d9640a", "#0b8a62", "#b5408e", "#8257e5", "#a17a00", "#0a86a8", "#c23b3b"];

export const colours = () => (dark.matches ? DARK : LIGHT);
export const whenChanged = (act) => dark.addEventListener("change", act);
export const walkerColour = (number) => WALKERS[number % WALKERS.length];
