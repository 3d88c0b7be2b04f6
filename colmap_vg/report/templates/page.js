"use strict";
// Sets the page up: colours, controls, and what follows a selection.
function systemTheme() {
  return matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
}

function applyTheme(theme) {
  document.documentElement.dataset.theme = theme;
  byId("theme").textContent = theme === "dark" ? "Light" : "Dark";
}

function draw() {
  drawCharts();
  return drawScene();
}

let waiting = 0;
function drawEdgesSoon() {
  clearTimeout(waiting);
  waiting = setTimeout(drawEdges, 150);
}

function setUpControls() {
  models.forEach((model, index) => byId("model").append(
    element("option", `${model.name} (${model.images.length} images)`, { value: index })));
  byId("model-choice").hidden = models.length < 2;
  byId("model").addEventListener("change", (event) => { chooseModel(Number(event.target.value)); draw(); });
  for (const id of ["min-inliers", "max-error"]) byId(id).addEventListener("input", drawEdgesSoon);
  byId("edge-color").addEventListener("change", drawEdges);
  byId("show-pairs").addEventListener("change", drawEdges);
  byId("show-points").addEventListener("change", drawScene);
  byId("show-cameras").addEventListener("change", drawScene);
  byId("worst").addEventListener("click", () => { if (worstShown() >= 0) select({ pair: worstShown() }, "controls"); });
  for (const button of document.querySelectorAll("[data-eye]")) {
    const [x, y, z] = button.dataset.eye.split(",").map(Number);
    button.addEventListener("click", () => Plotly.relayout("model-view", { "scene.camera": { eye: { x, y, z }, up: { x: 0, y: 0, z: 1 } } }));
  }
  byId("theme").addEventListener("click", () => {
    applyTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
    draw();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { applyTheme(systemTheme()); draw(); });
}

// A selected image or pair of another model shows that model.
selection.listeners.push(({ image, pair }) => {
  const row = image ?? pairs.a[pair];
  const index = models.findIndex((model) => model.name === images.model[row]);
  if (index >= 0 && index !== view.model) {
    chooseModel(index);
    draw();
  } else {
    drawPicked();
  }
});

applyTheme(systemTheme());
setUpControls();
fillErrorLegend();
if (models.length) chooseModel(0);
makeTables();
draw().then(() => {
  listenToScene();
  listenToCharts();
  document.documentElement.dataset.ready = "1";
});
