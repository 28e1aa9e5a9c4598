// Charts, stacked over one time axis.

const ROW = 128,
  TITLE = 30,
  GAP = 10; // [px] height of a chart, of its title, of the gap below
const LEAST = 0.05; // lower end of logarithmic axes

const charts = here("charts");

const runsOf = (line) => {
  // runs of rows with a known value
  const found = [[]];
  line.low.forEach((low, n) => (Number.isFinite(low) ? found[found.length - 1].push(n) : found.push([])));
  return found.filter((run) => run.length);
};
const spread = (line) => {
  // a polygon around low and high of each run
  const x = [],
    y = [];
  for (const run of runsOf(line)) {
    const back = [...run].reverse();
    x.push(...run.map((n) => line.time[n]), ...back.map((n) => line.time[n]), NaN);
    y.push(...run.map((n) => line.low[n]), ...back.map((n) => line.high[n]), NaN);
  }
  return {
    type: "scatter",
    mode: "lines",
    x,
    y,
    fill: "toself",
    fillcolor: pale(visible(line.colour), 0.2),
    line: { width: 0 },
    hoverinfo: "skip",
  };
};
const visible = (colour) =>
  // on a dark page half way to white
  theme === LIGHT ? colour : "#" + colour.slice(1).replace(/../g, (part) => ((parseInt(part, 16) + 255) >> 1).toString(16));
const tracesOf = (chart, number) =>
  chart.lines.flatMap((line) => {
    const drawn = {
      type: "scatter",
      mode: line.mode || "lines",
      x: line.time,
      y: line.y,
      customdata: line.time,
      line: { color: visible(line.colour), width: line.width || 1.5, shape: line.shape || "linear" },
      marker: weighted(line, line.time.length > MANY ? 5 : 7),
      text: line.time.map(
        (when, n) =>
          `${clock(when)}<br>` +
          (line.text ? plain(line.text[n]) : `${plain(line.name)} ${+line.y[n].toPrecision(4)} ${plain(chart.unit)}`),
      ),
      hoverinfo: "text",
    };
    return [...(line.low ? [spread(line)] : []), drawn].map((trace) => ({
      ...trace,
      yaxis: `y${number + 1}`,
      showlegend: false,
    }));
  });
const decades = (chart) => {
  // range and ticks of a logarithmic axis
  const known = chart.lines.flatMap((line) => line.y).filter((y) => y > LEAST);
  const low = known.reduce((a, b) => Math.min(a, b), known.length ? Infinity : LEAST);
  const high = known.reduce((a, b) => Math.max(a, b), low);
  const within = (times) => {
    const values = [];
    for (let power = -3; power < 6; power++) values.push(...times.map((one) => one * 10 ** power));
    return values.filter((value) => value >= low * 0.8 && value <= high * 1.25);
  };
  const ticks = [[1], [1, 2, 5], [1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9]].map(within).find((values) => values.length > 1) || [low];
  const names = ticks.map((value) => `${+value.toPrecision(2)}`);
  return { range: [Math.log10(low) - 0.1, Math.log10(high) + 0.1], tickvals: ticks, ticktext: names };
};
const titled = (chart) => {
  const several = chart.lines.length > 1 || chart.lines.some((line) => line.low);
  const key = (line) => `<span style="color:${visible(line.colour)}">${plain(line.name.split(",")[0])}</span>`;
  const lines = several && !chart.labels ? chart.lines.map(key).join("  ") : "";
  return `<b>${plain(chart.title)}</b>${chart.unit ? ` [${plain(chart.unit)}]` : ""}  ${lines}`;
};
const heights = content.charts.map((chart) => chart.height || ROW);
const total = heights.reduce((sum, height) => sum + height, 0);
const heightOfCharts = () => total + 50;
const rangeOfCharts = () => {
  const beside = 0.01 * (content.end - content.start);
  return [content.start - beside, content.end + beside];
};
const drawCharts = () => {
  const count = content.charts.length;
  const tops = heights.map((_, n) => 1 - heights.slice(0, n).reduce((sum, height) => sum + height, 0) / total);
  const layout = {
    font: font(),
    height: heightOfCharts(),
    margin: { l: 54, r: 12, t: 4, b: 30 },
    paper_bgcolor: theme.card,
    plot_bgcolor: theme.card,
    dragmode: "zoom",
    hovermode: "closest",
    xaxis: {
      range: rangeOfCharts(),
      ...ticks(content.start, content.end),
      anchor: `y${count}`,
      gridcolor: theme.line,
      zeroline: false,
      tickfont: { color: theme.soft, size: 11 },
    },
    shapes: [
      {
        name: "cursor",
        type: "line",
        xref: "x",
        yref: "paper",
        x0: time,
        x1: time,
        y0: 0,
        y1: 1,
        line: { color: theme.ink, width: 1, dash: "dot" },
      },
    ],
    annotations: content.charts.map((chart, n) => ({
      xref: "paper",
      yref: "paper",
      x: 0,
      y: tops[n],
      xanchor: "left",
      yanchor: "top",
      showarrow: false,
      align: "left",
      font: { size: 12 },
      text: titled(chart),
    })),
    hoverlabel: { bgcolor: theme.card, font: font(), align: "left" },
  };
  content.charts.forEach((chart, n) => {
    layout[`yaxis${n + 1}`] = {
      domain: [tops[n] - (heights[n] - GAP) / total, tops[n] - TITLE / total],
      gridcolor: theme.line,
      zeroline: false,
      nticks: 6,
      tickfont: { color: theme.soft, size: 11 },
      fixedrange: true,
      automargin: true,
      type: chart.logarithmic ? "log" : "linear",
      rangemode: chart.from_zero ? "tozero" : "normal",
      ...(chart.labels
        ? {
            tickvals: chart.labels.map((_, k) => k),
            ticktext: chart.labels.map(plain),
            range: [-0.6, chart.labels.length - 0.4],
          }
        : {}),
      ...(chart.logarithmic ? decades(chart) : {}),
    };
  });
  return Plotly.react(charts, content.charts.flatMap(tracesOf), layout, {
    ...CONFIG,
    scrollZoom: false,
    displayModeBar: false,
  });
};
