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
    fillcolor: pale(line.colour, 0.2),
    line: { width: 0 },
    hoverinfo: "skip",
  };
};
const tracesOf = (chart, number) =>
  chart.lines.flatMap((line) => {
    const drawn = {
      type: "scatter",
      mode: line.mode || "lines",
      x: line.time,
      y: line.y,
      customdata: line.time,
      line: { color: line.colour, width: line.width || 1.5, shape: line.shape || "linear" },
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
  return { range: [Math.log10(low) - 0.1, Math.log10(high) + 0.1], dtick: high / low > 20 ? 1 : "D2" };
};
const titled = (chart) => {
  const several = chart.lines.length > 1 || chart.lines.some((line) => line.low);
  const key = (line) => `<span style="color:${line.colour}">${plain(line.name)}</span>`;
  const lines = several && !chart.labels ? chart.lines.map(key).join("  ") : "";
  return `<b>${plain(chart.title)}</b>${chart.unit ? ` [${plain(chart.unit)}]` : ""}  ${lines}`;
};
const drawCharts = () => {
  const count = content.charts.length,
    heights = content.charts.map((chart) => chart.height || ROW),
    total = heights.reduce((sum, height) => sum + height, 0);
  const beside = 0.01 * (content.end - content.start);
  const tops = heights.map((_, n) => 1 - heights.slice(0, n).reduce((sum, height) => sum + height, 0) / total);
  const layout = {
    font: FONT,
    height: total + 50,
    margin: { l: 54, r: 12, t: 4, b: 30 },
    paper_bgcolor: "#fff",
    plot_bgcolor: "#fff",
    dragmode: "zoom",
    hovermode: "closest",
    xaxis: {
      range: [content.start - beside, content.end + beside],
      ...ticks(content.start, content.end),
      anchor: `y${count}`,
      gridcolor: LINE,
      zeroline: false,
      tickfont: { color: SOFT, size: 11 },
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
        line: { color: INK, width: 1, dash: "dot" },
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
    hoverlabel: { bgcolor: "#fff", font: FONT, align: "left" },
  };
  content.charts.forEach((chart, n) => {
    layout[`yaxis${n + 1}`] = {
      domain: [tops[n] - (heights[n] - GAP) / total, tops[n] - TITLE / total],
      gridcolor: LINE,
      zeroline: false,
      nticks: 4,
      tickfont: { color: SOFT, size: 11 },
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
  return Plotly.newPlot(charts, content.charts.flatMap(tracesOf), layout, {
    ...CONFIG,
    scrollZoom: false,
    displayModeBar: false,
  });
};
