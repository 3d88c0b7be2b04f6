"use strict";
// The report's data, its colours, and small helpers. File names are data: they are shown by textContent only.
const report = JSON.parse(document.getElementById("data").textContent);
const { images, pairs, models } = report;
const used = new Set(report.used);
const numPairs = pairs.a.length;

const VERDICT_COLORS = {
  kept: "#4c8fd6", rotation_only: "#2aa198", rotation_outlier: "#d64550", direction_outlier: "#e8833a",
  contradicts_poses: "#9966dd", reversed: "#c2478d", one_dsfm: "#b8860b", outside_component: "#8592a3",
  uncalibrated: "#a5917a", few_inliers: "#a3acb8", no_pose: "#a3acb8", degenerate: "#a3acb8", watermark: "#a3acb8",
  excluded: "#a3acb8",
};
const ERROR_STEPS = [[0.5, "#3a86c8"], [1, "#4fb3a5"], [2, "#b5c334"], [5, "#f2a33c"], [Infinity, "#d64550"]];

function verdictColor(word) {
  return VERDICT_COLORS[word] || "#8592a3";
}

function errorColor(degrees) {
  return degrees === null ? "#8592a3" : ERROR_STEPS.find(([limit]) => degrees <= limit)[1];
}

function byId(id) {
  return document.getElementById(id);
}

// An element with text and attributes; text is never read as HTML.
function element(tag, text = "", attributes = {}) {
  const made = document.createElement(tag);
  if (text !== "") made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

function style(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function unpack(text, Type) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  return new Type(bytes.buffer);
}

function degrees(value) {
  return value === null ? "" : `${value < 10 ? value.toFixed(2) : value.toFixed(1)}°`;
}

function imageName(row) {
  return row < 0 ? "unknown image" : images.name[row];
}

function imageReason(row) {
  return report.imageReasons[images.verdict[row]];
}

function pairReason(pair) {
  return report.pairReasons[pairs.verdict[pair]];
}

function imageLines(row) {
  const lines = [images.model[row] === "" ? "not registered" : `in model ${images.model[row]}`];
  const word = images.verdict[row], reason = imageReason(row);
  lines.push(word === reason ? word : `${word}: ${reason}`);
  lines.push(`${images.kept[row]} of its ${images.pairs[row]} pairs were kept`);
  if (images.position_sigma[row] !== null) {
    lines.push(`standard deviations: position ${images.position_sigma[row]} % of the scene's radius, ` +
      `rotation ${degrees(images.rotation_sigma[row])}`);
  }
  return lines;
}

function pairFigures(pair) {
  const figures = [["Verdict", pairs.verdict[pair]]];
  if (pairs.inliers[pair] !== null) figures.push(["Inlier matches", pairs.inliers[pair].toLocaleString("en")]);
  if (pairs.rotation[pair] !== null) figures.push(["Rotation error", degrees(pairs.rotation[pair])]);
  if (pairs.direction[pair] !== null) figures.push(["Direction error", degrees(pairs.direction[pair])]);
  if (pairs.sigmas[pair] !== null) figures.push(["Standard deviations", pairs.sigmas[pair].toFixed(1)]);
  return figures;
}

// What is selected: {image: row}, {pair: row} or {}; listeners are called after each change.
const selection = { current: {}, listeners: [] };

function select(chosen, from = "") {
  selection.current = chosen;
  for (const listener of selection.listeners) listener(chosen, from);
}
