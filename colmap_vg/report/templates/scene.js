"use strict";
// The 3-D view: points, cameras as frusta, and the pairs that pass the filters.
const view = { model: 0, shown: [], config: { displaylogo: false, responsive: true, scrollZoom: true,
  modeBarButtons: [["zoom3d", "pan3d", "orbitRotation", "resetCameraDefault3d"]] } };
const TRACES = { points: 0, frusta: 1, cameras: 2, edges: 3, middles: 4, picked: 5 };

function currentModel() {
  return models[view.model];
}

// Place of each image of the current model in its arrays.
function places() {
  const found = new Map();
  if (currentModel()) currentModel().images.forEach((row, place) => found.set(row, place));
  return found;
}

function pairsOfModel() {
  const inside = places();
  return Array.from({ length: numPairs }, (_, k) => k).filter((k) => inside.has(pairs.a[k]) && inside.has(pairs.b[k]));
}

// Largest error by which the view's filter judges a pair: that of its colour, of rotation unless asked otherwise.
function errorOf(pair) {
  return byId("edge-color").value === "direction" ? pairs.direction[pair] : pairs.rotation[pair];
}

// The pairs that the filters keep; where a maximum error is set, also how many have no known error.
function filtered() {
  const wanted = new Set([...document.querySelectorAll("#verdicts input:checked")].map((box) => box.value));
  const least = Number(byId("min-inliers").value) || 0;
  const text = byId("max-error").value;
  const most = text === "" ? Infinity : Number(text);
  const found = pairsOfModel().filter((k) => wanted.has(pairs.verdict[k]) && (pairs.inliers[k] ?? Infinity) >= least);
  if (most === Infinity) return [found, 0];
  const known = found.filter((k) => errorOf(k) !== null);
  return [known.filter((k) => errorOf(k) <= most), found.length - known.length];
}

function describeCount(shown, unknown) {
  const hidden = unknown ? `; ${unknown.toLocaleString("en")} hidden, whose error is unknown` : "";
  return `${shown.toLocaleString("en")} of ${pairsOfModel().length.toLocaleString("en")} pairs shown${hidden}`;
}

function columns() {
  return { x: [], y: [], z: [] };
}

function push(line, point) {
  line.x.push(point[0]);
  line.y.push(point[1]);
  line.z.push(point[2]);
}

function pushFrustum(line, center, corners) {
  for (const stop of [corners[0], corners[1], corners[2], corners[3], corners[0], center, corners[1]]) push(line, stop);
  push(line, [null, null, null]);
  for (const stop of [corners[2], center, corners[3]]) push(line, stop);
  push(line, [null, null, null]);
}

function pointTrace(model) {
  const xyz = unpack(model.points, Float32Array), rgb = unpack(model.colors, Uint8Array);
  const line = columns(), colors = [];
  for (let k = 0; k < xyz.length; k += 3) {
    push(line, [xyz[k], xyz[k + 1], xyz[k + 2]]);
    if (rgb.length) colors.push(`rgb(${rgb[k]},${rgb[k + 1]},${rgb[k + 2]})`);
  }
  const size = xyz.length > 60000 ? 1.3 : 2;
  return { ...line, type: "scatter3d", mode: "markers", hoverinfo: "skip",
    marker: { size, color: rgb.length ? colors : style("point"), line: { width: 0 } } };
}

function cameraTraces(model) {
  const frusta = columns(), centers = columns();
  model.centers.forEach((center, place) => {
    pushFrustum(frusta, center, model.corners[place]);
    push(centers, center);
  });
  return [
    { ...frusta, type: "scatter3d", mode: "lines", hoverinfo: "skip", line: { color: style("camera"), width: 1.5 } },
    { ...centers, type: "scatter3d", mode: "markers", hoverinfo: "none", customdata: model.images,
      marker: { size: 3.5, color: style("camera"), line: { width: 0 } } },
  ];
}

function edgeTraces(model) {
  const lines = columns(), middles = columns(), colors = [], dots = [], inside = places();
  const [shown, unknown] = filtered();
  view.shown = shown;
  const choice = byId("edge-color").value;
  byId("error-legend").hidden = choice === "verdict";
  for (const k of view.shown) {
    const [a, b] = [model.centers[inside.get(pairs.a[k])], model.centers[inside.get(pairs.b[k])]];
    const color = choice === "verdict" ? verdictColor(pairs.verdict[k]) : errorColor(errorOf(k));
    for (const stop of [a, b, [null, null, null]]) {
      push(lines, stop);
      colors.push(color);
    }
    push(middles, a.map((value, axis) => (value + b[axis]) / 2));
    dots.push(color);
  }
  byId("count").textContent = describeCount(shown.length, unknown);
  const visible = byId("show-pairs").checked;
  const many = view.shown.length > 400;
  return [
    { ...lines, type: "scatter3d", mode: "lines", hoverinfo: "skip", connectgaps: false, visible,
      opacity: many ? 0.35 : 0.7, line: { color: colors, width: many ? 1 : 2 } },
    { ...middles, type: "scatter3d", mode: "markers", hoverinfo: "none", customdata: view.shown, visible,
      opacity: many ? 0.5 : 0.9, marker: { size: many ? 1.5 : 2.5, color: dots, line: { width: 0 } } },
  ];
}

function pickedTrace(model) {
  const line = columns(), inside = places(), { image, pair } = selection.current;
  const rows = image !== undefined ? [image] : pair !== undefined ? [pairs.a[pair], pairs.b[pair]] : [];
  const found = rows.filter((row) => inside.has(row)).map((row) => inside.get(row));
  for (const place of found) pushFrustum(line, model.centers[place], model.corners[place]);
  if (found.length === 2) for (const place of found) push(line, model.centers[place]);
  if (!found.length) push(line, [null, null, null]);
  return { ...line, type: "scatter3d", mode: "lines", hoverinfo: "skip", line: { color: style("pick"), width: 5 } };
}

function sceneLayout(model) {
  const axis = (k) => ({ visible: false, range: [model.low[k], model.high[k]] });
  const sides = model.high.map((high, k) => high - model.low[k]);
  const [x, y, z] = sides.map((side) => 1.3 * side / Math.max(...sides));
  return {
    margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, paper_bgcolor: style("panel"), uirevision: view.model,
    scene: { aspectmode: "manual", aspectratio: { x, y, z }, xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), dragmode: "orbit",
      camera: { eye: { x: 1, y: 1, z: 0.8 } }, uirevision: view.model },
  };
}

function drawScene() {
  const model = currentModel();
  if (!model) return Promise.resolve();
  const traces = [pointTrace(model), ...cameraTraces(model), ...edgeTraces(model), pickedTrace(model)];
  traces[TRACES.points].visible = byId("show-points").checked;
  traces[TRACES.frusta].visible = traces[TRACES.cameras].visible = byId("show-cameras").checked;
  return Plotly.react("model-view", traces, sceneLayout(model), view.config);
}

// Replaces only some traces, so that many points are not read again.
function replaceTraces(traces, first) {
  const drawn = byId("model-view").data;
  if (!drawn) return;
  traces.forEach((trace, k) => { drawn[first + k] = trace; });
  Plotly.react("model-view", [...drawn], byId("model-view").layout, view.config);
}

function drawEdges() {
  if (currentModel()) replaceTraces(edgeTraces(currentModel()), TRACES.edges);
}

function drawPicked() {
  if (currentModel()) replaceTraces([pickedTrace(currentModel())], TRACES.picked);
}

// The worst of the pairs shown, by its rotation error: -1 where no error is known.
function worstShown() {
  return view.shown.reduce((worst, k) => (errorOf(k) ?? -1) > (worst < 0 ? -1 : errorOf(worst)) ? k : worst, -1);
}

function fillErrorLegend() {
  const labels = ERROR_STEPS.map(([limit], k) => limit === Infinity ? `> ${ERROR_STEPS[k - 1][0]}°` : `≤ ${limit}°`);
  byId("error-legend").replaceChildren(...ERROR_STEPS.map(([, color], k) => {
    const item = element("span"), dot = element("span", "", { class: "dot" });
    dot.style.background = color;
    item.append(dot, labels[k]);
    return item;
  }));
}

function fillVerdicts() {
  const counts = new Map();
  for (const k of pairsOfModel()) counts.set(pairs.verdict[k], (counts.get(pairs.verdict[k]) || 0) + 1);
  const box = byId("verdicts");
  box.replaceChildren(box.querySelector("legend"));
  for (const [word, count] of [...counts].sort((one, other) => other[1] - one[1])) {
    const label = element("label", "", { title: report.pairReasons[word] });
    const input = element("input", "", { type: "checkbox", value: word });
    input.checked = used.has(word);
    input.addEventListener("change", drawEdges);
    const dot = element("span", "", { class: "dot" });
    dot.style.background = verdictColor(word);
    label.append(input, dot, element("span", word), element("small", count.toLocaleString("en")));
    box.append(label);
  }
}

function chooseModel(index) {
  view.model = index;
  byId("model").value = String(index);
  fillVerdicts();
}
