// State of the page (query, choice, camera), from which everything else is derived.

import * as api from "./api.js";
import { $, LEVELS } from "./elements.js";
import { isStopped, showStopped } from "./stopped.js";
import { KEPT } from "./styles.js";

export const host = $("view"), options = new URLSearchParams(location.search);
export const start = new URLSearchParams(location.hash.slice(1) || api.link);

export const page = { scene: null, camera: null, painter: null, photos: null, outline: null, chosen: -1, hover: -1, asked: null, kept: [], path: [], frustums: false, previewing: false, removed: "", marked: "", waiting: false, moving: false, slow: false };
export const outlines = new Map();                             // by variant
export const panes = [{ by: "", answer: null, field: null }]; // one, or two side by side

export const variantOf = (pane) => pane.by.split("|")[0];
export const answererOf = (pane) => pane.by.split("|")[1] || "tree";
export const level = () => document.querySelector("[name=level]:checked").value;
// Minimum score of an answer, or null for answers near the best.
export const threshold = () => $("threshold-on").checked ? Number($("threshold-at").value) : null;
export const levelIndex = (answer) => Math.max(0, LEVELS.indexOf(level() === "auto" ? answer?.level ?? "whole" : level()));
// Return a pane's kept queries that are painted, with their colours.
export const keptIn = (pane) => page.kept.filter((query) => query.shown && query.answers.has(panes[pane].by)).map((query) => ({ answer: query.answers.get(panes[pane].by), rgb: KEPT[query.colour], text: query.asked.text }));
export const main = () => outlines.get(variantOf(panes[0]));

// Set the controls and the camera as in a link.
export function openLink(link) {
  page.camera.fromText(link.get("c") ?? "", page.scene.views);
  for (const [id, usual] of [["colour", "answers"], ["mode", "tint"]]) $(id).value = [...$(id).options].some((o) => o.value === link.get(id)) ? link.get(id) : usual;
  const { level, least: threshold, view } = Object.fromEntries(link);
  setQuery({ level, threshold, view });
}

export function setQuery({ level = "auto", threshold: least, view }) {
  for (const radio of document.querySelectorAll("[name=level]")) radio.checked = radio.value === level;
  $("here").checked = view !== undefined;
  $("threshold-on").checked = least !== undefined;
  if (least !== undefined) $("threshold-at").value = least;
  $("threshold-on").dispatchEvent(new Event("change"));
}

export function tell(text, error = false) { $("status").textContent = text; $("status").classList.toggle("error", error); }
export const failed = (error) => {
  if (error.status === 409) sceneChanged();
  if (isStopped(error)) showStopped(true);
  if (error.name !== "AbortError") tell(error.message, true);
};

// Until a reload, the page shows the state with which it was loaded.
export function sceneChanged(parts = []) {
  $("changed").hidden = false;
  $("changed-what").textContent = `The scene has changed${parts.length ? ` (${parts.join(", ")})` : ""}. The page still shows the previous state.`;
}

export async function loadVariant(name) {
  if (outlines.has(name)) return;
  const [described] = await Promise.all([api.variant(name), page.painter.loadNodes(name)]);
  outlines.set(name, described);
}
