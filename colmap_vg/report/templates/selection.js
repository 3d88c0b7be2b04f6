"use strict";
// The card at the pointer, and the panel on what is selected.
const pointer = { x: 0, y: 0 };

function showCard(event) {
  const card = byId("card"), point = event.points[0];
  const row = point.customdata;
  card.replaceChildren();
  if (point.curveNumber === TRACES.cameras) {
    if (images.photograph[row]) card.append(element("img", "", { src: images.photograph[row], alt: "" }));
    card.append(element("p", imageName(row), { class: "title" }));
    for (const line of imageLines(row)) card.append(element("p", line));
  } else {
    card.append(element("p", `${imageName(pairs.a[row])} – ${imageName(pairs.b[row])}`, { class: "title" }));
    for (const [name, value] of pairFigures(row)) card.append(element("p", `${name}: ${value}`));
  }
  card.hidden = false;
  const place = byId("model-view").getBoundingClientRect();
  const left = pointer.x - place.left, top = pointer.y - place.top;
  card.style.left = `${Math.max(0, Math.min(left + 14, place.width - card.offsetWidth - 4))}px`;
  card.style.top = `${Math.max(0, Math.min(top + 14, place.height - card.offsetHeight - 4))}px`;
}

function listenToScene() {
  const scene = byId("model-view");
  if (!scene.on) return;
  scene.addEventListener("pointermove", ({ clientX, clientY }) => Object.assign(pointer, { x: clientX, y: clientY }), true);
  scene.on("plotly_hover", showCard);
  scene.on("plotly_unhover", () => { byId("card").hidden = true; });
  scene.on("plotly_click", (event) => {
    const { curveNumber, customdata } = event.points[0];
    const kind = curveNumber === TRACES.cameras ? "image" : "pair";
    // Sent with each frame while the button is down, in the middle of drawing: drawing again waits for its end.
    if (selection.current[kind] !== customdata) setTimeout(select, 0, { [kind]: customdata }, "view");
  });
}

function svg(tag, attributes) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

// Two photographs one above the other, with lines between their matches.
function drawPair(pair) {
  const rows = [pairs.a[pair], pairs.b[pair]];
  const sources = rows.map((row) => images.photograph[row] || "");
  const matches = report.matches[pair] || [];
  if (!matches.length && !sources.some(Boolean)) return null;
  const picture = svg("svg", { role: "img", "aria-label": `The two images and ${matches.length} matches` });
  Promise.all(sources.map(loaded)).then((ratios) => {
    const width = 300, gap = 6, heights = ratios.map((ratio) => width / ratio);
    const tops = [0, heights[0] + gap];
    picture.setAttribute("viewBox", `0 0 ${width} ${tops[1] + heights[1]}`);
    sources.forEach((source, k) => {
      const frame = { x: 0, y: tops[k], width, height: heights[k] };
      picture.append(source ? svg("image", { ...frame, href: source }) : svg("rect", { ...frame, fill: style("line") }));
    });
    matches.forEach(([x1, y1, x2, y2], k) => {
      const color = `hsl(${(k * 137.5) % 360} 85% 58%)`;
      const ends = { x1: x1 * width, y1: tops[0] + y1 * heights[0], x2: x2 * width, y2: tops[1] + y2 * heights[1] };
      picture.append(svg("line", { ...ends, stroke: color, "stroke-width": 0.8, "stroke-opacity": 0.75 }));
      picture.append(svg("circle", { cx: ends.x1, cy: ends.y1, r: 1.6, fill: color }));
      picture.append(svg("circle", { cx: ends.x2, cy: ends.y2, r: 1.6, fill: color }));
    });
  });
  return picture;
}

// Width over height of a picture, once it is decoded.
function loaded(source) {
  return new Promise((resolve) => {
    if (!source) return resolve(1.5);
    const picture = new Image();
    picture.onload = () => resolve(picture.naturalWidth / picture.naturalHeight);
    picture.onerror = () => resolve(1.5);
    picture.src = source;
  });
}

function imageButton(row) {
  const button = element("button", imageName(row), { type: "button" });
  if (row >= 0) button.addEventListener("click", () => select({ image: row }, "panel"));
  return button;
}

function pairPanel(pair) {
  const made = [element("h3", "Pair"), element("p", `${imageName(pairs.a[pair])}\n${imageName(pairs.b[pair])}`,
    { class: "title" })];
  const list = element("dl");
  for (const [name, value] of pairFigures(pair)) list.append(element("dt", name), element("dd", value));
  made.push(element("p", pairReason(pair), { class: "quiet" }), list);
  const picture = drawPair(pair);
  if (picture) made.push(picture);
  const known = (report.matches[pair] || []).length;
  made.push(element("p", known ? `${known} of its matches are drawn.` : "Its matches are not part of this report.",
    { class: "quiet" }));
  const both = element("ol");
  for (const row of [pairs.a[pair], pairs.b[pair]]) {
    const item = element("li");
    item.append(imageButton(row));
    both.append(item);
  }
  made.push(element("h3", "Its images"), both);
  return made;
}

function imagePanel(row) {
  const made = [element("h3", "Image"), element("p", imageName(row), { class: "title" })];
  if (images.photograph[row]) made.push(element("img", "", { src: images.photograph[row], alt: "Photograph" }));
  for (const line of imageLines(row)) made.push(element("p", line));
  const own = Array.from({ length: numPairs }, (_, k) => k).filter((k) => pairs.a[k] === row || pairs.b[k] === row);
  own.sort((one, other) => (pairs.inliers[other] ?? 0) - (pairs.inliers[one] ?? 0));
  const list = element("ol");
  for (const k of own.slice(0, 12)) {
    const item = element("li"), other = pairs.a[k] === row ? pairs.b[k] : pairs.a[k];
    const button = element("button", "", { type: "button" });
    const dot = element("span", "", { class: "dot" });
    dot.style.background = verdictColor(pairs.verdict[k]);
    button.append(dot, `${imageName(other)}, ${pairs.inliers[k] ?? "?"} inliers, ${pairs.verdict[k]}`);
    button.addEventListener("click", () => select({ pair: k }, "panel"));
    item.append(button);
    list.append(item);
  }
  if (own.length) made.push(element("h3", own.length > 12 ? `12 strongest of ${own.length} pairs` : "Its pairs"), list);
  return made;
}

selection.listeners.push(({ image, pair }) => {
  if (image !== undefined) byId("selected").replaceChildren(...imagePanel(image));
  else if (pair !== undefined) byId("selected").replaceChildren(...pairPanel(pair));
});
