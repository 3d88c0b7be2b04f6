"use strict";
// Histograms, the agreement of pairs, and the match matrix of the chosen model.
const plain = { displayModeBar: false, responsive: true };
const NUM_BINS = 36;

function chartLayout(xaxis, yaxis, more = {}) {
  const axis = { gridcolor: style("line"), zerolinecolor: style("line"), linecolor: style("line"), automargin: true };
  return { margin: { l: 46, r: 10, t: 6, b: 40 }, paper_bgcolor: style("panel"), plot_bgcolor: style("panel"),
    font: { color: style("soft"), size: 11 }, bargap: 0.06, showlegend: false,
    xaxis: { ...axis, ...xaxis }, yaxis: { ...axis, ...yaxis }, ...more };
}

// Histogram of errors on a logarithmic axis, of used pairs and of the others.
function errorChart(id, values) {
  const known = pairsOfModel().filter((k) => values[k] !== null);
  const floor = 0.001, logs = (k) => Math.log10(Math.max(values[k], floor));
  const low = Math.log10(0.01), high = Math.log10(180), width = (high - low) / NUM_BINS;
  const traces = [["used", true, "#4c8fd6"], ["not used", false, "#d64550"]].map(([name, wanted, color]) => {
    const counts = new Array(NUM_BINS).fill(0);
    for (const k of known) {
      if (used.has(pairs.verdict[k]) !== wanted) continue;
      counts[Math.max(0, Math.min(NUM_BINS - 1, Math.floor((logs(k) - low) / width)))] += 1;
    }
    return { type: "bar", name, y: counts, x: counts.map((_, k) => low + (k + 0.5) * width), width, marker: { color },
      hovertemplate: "%{y}<extra>%{fullData.name}</extra>" };
  });
  const ticks = [0.01, 0.1, 1, 10, 100];
  Plotly.react(id, traces, chartLayout(
    { title: { text: "degrees" }, tickvals: ticks.map(Math.log10), ticktext: ticks.map((tick) => `${tick}°`) },
    { title: { text: "pairs" } },
    { barmode: "stack", showlegend: true, legend: { orientation: "h", x: 1, xanchor: "right", y: 1.02, yanchor: "bottom" } },
  ), plain);
}

function pointCharts(model) {
  const edges = model.errorEdges, width = edges[1] - edges[0], color = "#4c8fd6";
  Plotly.react("chart-errors", [{ type: "bar", x: model.errorCounts.map((_, k) => edges[k] + width / 2), width,
    y: model.errorCounts, marker: { color }, hovertemplate: "%{x:.2f} px: %{y}<extra></extra>" }],
  chartLayout({ title: { text: "pixels, the last bar and all beyond" } }, { title: { text: "points" } }), plain);
  const last = model.trackCounts.reduce((found, count, k) => (count ? k : found), 2);
  const lengths = Array.from({ length: last - 1 }, (_, k) => k + 2);
  Plotly.react("chart-tracks", [{ type: "bar", x: lengths, y: lengths.map((length) => model.trackCounts[length]),
    marker: { color }, hovertemplate: "%{x} images: %{y}<extra></extra>" }],
  chartLayout({ title: { text: `images per point${last === model.trackCounts.length - 1 ? ", the last bar and more" : ""}` } },
    { title: { text: "points, logarithmic" }, type: "log", dtick: 1 }), plain);
}

// Each pair by its inlier matches and its rotation error: those at the upper right contradict the model most.
function agreementChart() {
  const known = pairsOfModel().filter((k) => pairs.rotation[k] !== null && pairs.inliers[k] > 0);
  Plotly.react("chart-agreement", [{ type: "scattergl", mode: "markers", hoverinfo: "none", customdata: known,
    x: known.map((k) => pairs.inliers[k]), y: known.map((k) => Math.max(pairs.rotation[k], 0.001)),
    marker: { size: 5, opacity: 0.65, color: known.map((k) => verdictColor(pairs.verdict[k])) } }],
  chartLayout({ title: { text: "inlier matches" }, type: "log", dtick: 1 },
    { title: { text: "rotation error" }, type: "log", dtick: 1, ticksuffix: "°" },
    { shapes: [{ type: "line", xref: "paper", x0: 0, x1: 1, y0: 5, y1: 5, line: { color: style("bad"), width: 1, dash: "dot" } }] }), plain);
}

function matrixChart() {
  const collator = new Intl.Collator("en", { numeric: true });
  const order = images.name.map((_, row) => row).filter((row) => images.pairs[row] > 0);
  order.sort((one, other) => collator.compare(images.name[one], images.name[other]));
  const place = new Map(order.map((row, k) => [row, k])), size = order.length;
  const cells = order.map(() => new Array(size).fill(null)), which = order.map(() => new Array(size).fill(-1));
  for (let k = 0; k < numPairs; k += 1) {
    const i = place.get(pairs.a[k]), j = place.get(pairs.b[k]);
    if (i === undefined || j === undefined || !pairs.inliers[k]) continue;
    cells[i][j] = cells[j][i] = Math.log10(pairs.inliers[k]);
    which[i][j] = which[j][i] = k;
  }
  const dark = document.documentElement.dataset.theme === "dark";
  const scale = dark ? [[0, "#1d3557"], [0.5, "#3a7ca5"], [1, "#d9f0ff"]] : [[0, "#dbe9f6"], [0.5, "#4a90c4"], [1, "#08306b"]];
  const ticks = [1, 10, 100, 1000, 10000];
  Plotly.react("chart-matrix", [{ type: "heatmap", z: cells, customdata: which, hoverinfo: "none", colorscale: scale,
    colorbar: { thickness: 10, outlinewidth: 0, tickvals: ticks.map(Math.log10), ticktext: ticks.map(String) },
    xgap: size < 60 ? 1 : 0, ygap: size < 60 ? 1 : 0 }],
  chartLayout({ title: { text: "image" }, showgrid: false, zeroline: false },
    { title: { text: "image" }, showgrid: false, autorange: "reversed", zeroline: false }), plain);
}

function drawCharts() {
  if (numPairs) matrixChart();
  if (!currentModel()) return;
  errorChart("chart-rotation", pairs.rotation);
  errorChart("chart-direction", pairs.direction);
  pointCharts(currentModel());
  agreementChart();
}

// Clicks in the agreement chart and the matrix select a pair; the caption names the pair under the pointer.
function listenToCharts() {
  for (const id of ["chart-agreement", "chart-matrix"]) {
    const chart = byId(id), told = chart.parentElement.querySelector("output");
    if (!chart.on) continue;
    const pairAt = (event) => event.points[0].customdata;
    chart.on("plotly_hover", (event) => {
      const k = pairAt(event);
      told.textContent = k < 0 ? "" : `${imageName(pairs.a[k])} – ${imageName(pairs.b[k])}, ${pairs.inliers[k]} inliers, ` +
        [pairs.verdict[k], degrees(pairs.rotation[k])].join(" ");
    });
    chart.on("plotly_unhover", () => { told.textContent = ""; });
    chart.on("plotly_click", (event) => { if (pairAt(event) >= 0) select({ pair: pairAt(event) }, "table"); });
  }
}
