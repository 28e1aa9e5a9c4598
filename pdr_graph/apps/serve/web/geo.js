// Positions on the map. A walk without georeference is drawn about longitude 0, latitude 0, as its plan is.

const METRES_PER_DEGREE = 111319.49; // at latitude 0, as in plan_layers.py
const CORNERS = 48; // of an ellipse
const SPACING = 10; // [m] of the grid
const LINES = 60; // of the grid on both sides

export const place = ({ lon, lat, x, y }) => {
  if (lon !== null && lon !== undefined) return [lon, lat];
  return x === null || x === undefined ? null : [x / METRES_PER_DEGREE, y / METRES_PER_DEGREE];
};

// Where the pose is shown: its display position, which does not jump.
export const shownAt = (pose) => {
  if (!pose.display) return place(pose);
  return pose.lon === null ? place({ x: pose.display[0], y: pose.display[1] }) : pose.display;
};

// A position some metres east and north of another.
export const moved = ([lon, lat], east, north) => [
  lon + east / (METRES_PER_DEGREE * Math.cos((lat * Math.PI) / 180)),
  lat + north / METRES_PER_DEGREE,
];

// The distance [m] of two positions that are near each other.
export const apart = ([lon, lat], [other, north]) =>
  METRES_PER_DEGREE * Math.hypot((other - lon) * Math.cos((lat * Math.PI) / 180), north - lat);

// The outline of a region, an ellipse with half axes [m] whose long one has an angle [rad] from east.
export const outline = (centre, { semi_major: a, semi_minor: b, angle }) =>
  Array.from({ length: CORNERS + 1 }, (_, n) => {
    const turn = (2 * Math.PI * (n % CORNERS)) / CORNERS,
      along = a * Math.cos(turn),
      across = b * Math.sin(turn);
    return moved(
      centre,
      along * Math.cos(angle) - across * Math.sin(angle),
      along * Math.sin(angle) + across * Math.cos(angle),
    );
  });

export const feature = (type, coordinates, properties) => ({
  type: "Feature",
  geometry: { type, coordinates },
  properties,
});
export const collection = (features) => ({ type: "FeatureCollection", features });

// The rows of a path (columns of equal length) as positions with floors.
export const rows = (columns) =>
  columns.x.map((x, n) => ({
    at: place({ x, y: columns.y[n], lon: columns.lon && columns.lon[n], lat: columns.lat && columns.lat[n] }),
    floor: columns.floor[n] || "",
  }));

// Consecutive rows on one floor as lines, each from the last row of the line before.
export const linesOf = (points, properties) => {
  const lines = [];
  points.forEach((point, n) => {
    if (n && point.floor === points[n - 1].floor) lines[lines.length - 1].line.push(point.at);
    else lines.push({ floor: point.floor, line: n ? [points[n - 1].at, point.at] : [point.at] });
  });
  return lines
    .filter(({ line }) => line.length > 1)
    .map(({ floor, line }) => feature("LineString", line, { ...properties, floor }));
};

// The box around positions: [[west, south], [east, north]]; null without any.
export const boxOf = (positions) => {
  if (!positions.length) return null;
  const box = [
    [Infinity, Infinity],
    [-Infinity, -Infinity],
  ];
  for (const [lon, lat] of positions) {
    box[0] = [Math.min(box[0][0], lon), Math.min(box[0][1], lat)];
    box[1] = [Math.max(box[1][0], lon), Math.max(box[1][1], lat)];
  }
  return box;
};

// Lines about a place, east and north, every SPACING metres.
export const gridAbout = (centre) => {
  const end = LINES * SPACING,
    lines = Array.from({ length: 2 * LINES + 1 }, (_, n) => (n - LINES) * SPACING);
  return collection(
    lines.flatMap((at) => [
      feature("LineString", [moved(centre, at, -end), moved(centre, at, end)], {}),
      feature("LineString", [moved(centre, -end, at), moved(centre, end, at)], {}),
    ]),
  );
};
