// Removal of Gaussians, with undo: marks of selected and removed Gaussians, in the page's order. Files of the scene never
// change; saved pictures and files leave out what is removed, and the browser keeps it until the Gaussians change.

import * as api from "./api.js";
import { paneAt } from "./choosing.js";
import { currentStyles, overlay, restyle } from "./drawing.js";
import { $, counted, shape } from "./elements.js";
import { groups } from "./kept.js";
import { inOrder } from "./latest.js";
import { failed, host, page, panes, tell, variantOf } from "./state.js";
import { base64, wireStyle } from "./styles.js";

const SELECTED = 1, REMOVED = 2;
const LEAST_PX = 4, MOST_PX = 200;   // diameters of the brush
const MOST_UNDONE = 20;   // marks that can be undone, in multiples of the number of Gaussians: 100 bytes for each
let marks = new Uint8Array(0), done = [], undone = [], isKept = true;

const key = () => `hilsplat removed of ${page.scene.name}`;
const isEditing = () => !$("edit").hidden;
export const tool = () => isEditing() ? document.querySelector("[name=tool]:checked").value : "move";
const count = (mark) => marks.reduce((sum, each) => sum + (each === mark), 0);

const next = inOrder(failed);   // what is removed while a selection is on its way is that selection
export const edited = () => next(() => {});   // once all steps are taken

// Set all marks to `markOf` of the present mark and the number of the Gaussian, as one step that can be undone.
function become(markOf) {
  const rows = [], values = [];
  marks.forEach((mark, row) => { const next = markOf(mark, row); if (next !== mark) { rows.push(row); values.push(mark); marks[row] = next; } });
  if (!rows.length) return;
  done.push({ rows: Uint32Array.from(rows), values: Uint8Array.from(values) });
  while (done.reduce((sum, step) => sum + step.rows.length, 0) > MOST_UNDONE * marks.length) done.shift();
  undone = [];
  changed();
}

// Exchange the marks of the last step with those before it.
function exchange(from, to) {
  const step = from.pop();
  if (!step) return;
  step.values.forEach((value, k) => { const row = step.rows[k]; step.values[k] = marks[row]; marks[row] = value; });
  to.push(step);
  changed();
}

function bits(mark) {
  const packed = new Uint8Array(Math.ceil(marks.length / 8));
  marks.forEach((each, row) => { if (each === mark) packed[row >> 3] |= 1 << (row & 7); });
  return packed.some(Boolean) ? base64(packed) : "";
}

function changed() {
  Object.assign(page, { removed: bits(REMOVED), marked: bits(SELECTED) });
  try { localStorage.setItem(key(), `${page.scene.gaussians_sha256} ${page.removed}`); isKept = true; } catch { isKept = !page.removed; }
  page.painter.mark(marks);
  showCounts();
  restyle();
}

function showCounts() {
  const selected = count(SELECTED), removed = count(REMOVED);
  $("save-scene").hidden = !removed;
  $("save-scene").textContent = `Without ${counted(removed, "removed Gaussian")}`;
  $("edit-told").textContent = `${selected.toLocaleString("en")} selected, ${removed.toLocaleString("en")} removed of ${counted(marks.length, "Gaussian")}`;
  $("edit-restore").disabled = !removed;
  for (const id of ["edit-remove", "edit-crop", "edit-none"]) $(id).disabled = !selected;
  $("edit-undo").disabled = !done.length;
  $("edit-redo").disabled = !undone.length;
}

// how: new, add or subtract.
function select(packed, how) {
  become((mark, row) => {
    if (mark === REMOVED) return mark;
    if (packed[row >> 3] >> (row & 7) & 1) return how === "subtract" ? 0 : SELECTED;
    return how === "new" ? 0 : mark;
  });
}

// Select the Gaussians of the selected node, otherwise of all answers that are shown.
function selectNodes() {
  const nodes = page.chosen >= 0 ? [page.chosen] : groups().flatMap((group) => group.nodes);
  if (!nodes.length) { tell("Run a query or select a node first."); return; }
  selectMembers({ nodes });
}

function selectMembers(which) {
  const variant = variantOf(panes[0]), how = $("how").value;
  next(async () => select(new Uint8Array(await api.members({ variant, ...which })), how));
}

// Show the region that is being drawn, and select the Gaussians in it once it is `finished`.
export function draw(points, finished, { shiftKey, ctrlKey, metaKey }) {
  const at = paneAt(points[0][0]), isBrush = tool() === "brush", left = at.k * at.width, [[x0, y0], [x1, y1]] = [points[0], points.at(-1)];
  overlay();
  placeBrush(...points.at(-1));
  if (!finished) {
    $("overlay").append(isBrush ? shape("path", { class: "brush", d: `M${points.join("L")}L${points.at(-1)}`, "stroke-width": $("brush-size").value })
      : shape("path", { class: "frame", d: `M${x0} ${y0}H${x1}V${y1}H${x0}Z` }));
    return;
  }
  const region = { points: (isBrush ? points : [points[0], points.at(-1)]).map(([x, y]) => [x - left, y]), radius: isBrush ? Number($("brush-size").value) / 2 : 0 };
  const asked = { variant: variantOf(panes[at.k]) || "default", camera: page.camera.wire(at.width, at.height), style: wireStyle(currentStyles()[at.k]), ...region };
  const how = shiftKey ? "add" : ctrlKey || metaKey ? "subtract" : $("how").value;
  next(async () => select(new Uint8Array(await api.within(asked)), how));
}

export function placeBrush(x, y) {
  const size = Number($("brush-size").value);
  $("brush").hidden = tool() !== "brush" || x < 0;
  Object.assign($("brush").style, { left: `${x - size / 2}px`, top: `${y - size / 2}px`, width: `${size}px`, height: `${size}px` });
}

function setTool(name) {
  document.querySelector(`[name=tool][value=${name}]`).checked = true;
  toolChanged();
}

function toolChanged() {
  $("size").hidden = tool() !== "brush";
  host.classList.toggle("selecting", tool() !== "move");
  placeBrush(-1, -1);
}

// Make the brush smaller or larger; false if it isn't used.
export function resizeBrush(by) {
  if (tool() !== "brush") return false;
  $("brush-size").value = Math.min(MOST_PX, Math.max(LEAST_PX, Number($("brush-size").value) * 1.25 ** by));
  return true;
}

// Return to moving the camera; false if that is what dragging does.
export function leaveTool() {
  if (tool() === "move") return false;
  setTool("move");
  return true;
}

export function edit(open = !isEditing()) {
  $("edit").hidden = !open;
  $("edit-button").setAttribute("aria-pressed", String(open));
  toolChanged();
  if (!open) return;
  if (!marks.length) marks = new Uint8Array(page.scene.gaussians);
  showCounts();
}

// Remove what the browser has kept as removed from these Gaussians, by this tab or another one.
function readRemoved() {
  let kept = ["", ""];
  try { kept = (localStorage.getItem(key()) ?? " ").split(" "); } catch { /* a frame in another site's page may have no storage */ }
  if (kept[0] !== page.scene.gaussians_sha256) return;
  const packed = Uint8Array.from(atob(kept[1]), (letter) => letter.charCodeAt(0));
  if (!marks.length) marks = new Uint8Array(page.scene.gaussians);
  become((mark, row) => packed[row >> 3] >> (row & 7) & 1 ? REMOVED : mark === REMOVED ? 0 : mark);
}

export function restoreRemoved() {
  readRemoved();
  done = [];
  if (page.removed) edit(true);
  window.addEventListener("storage", (event) => { if (event.key === key()) next(readRemoved); });
}

const change = (markOf) => next(() => become(markOf));
const remove = () => change((mark) => mark === SELECTED ? REMOVED : mark);
const invert = () => change((mark) => mark === REMOVED ? mark : SELECTED - mark);
export const undo = () => next(() => exchange(done, undone)), redo = () => next(() => exchange(undone, done));
const ACTIONS = {
  "edit-nodes": selectNodes, "edit-loose": () => selectMembers({ loose: true }), "edit-invert": invert, "edit-none": () => change((mark) => mark === SELECTED ? 0 : mark), "edit-remove": remove,
  "edit-crop": () => change((mark) => mark === SELECTED ? 0 : REMOVED), "edit-restore": () => change((mark) => mark === REMOVED ? 0 : mark), "edit-undo": undo, "edit-redo": redo,
  "edit-save": () => { $("save").open = true; $("save").querySelector("[data-save=scene-ply]").focus(); },
};
const KEYS = { b: () => setTool("box"), c: () => setTool("brush"), h: () => setTool("move"), i: invert, Delete: remove, Backspace: remove };

// Act on a key of the edit bar; false if it has no meaning.
export function pressed(key) {
  if (!isEditing() || !KEYS[key]) return false;
  KEYS[key]();
  return true;
}

export function attachEditing() {
  for (const [id, act] of Object.entries(ACTIONS)) $(id).addEventListener("click", act);
  for (const radio of document.querySelectorAll("[name=tool]")) radio.addEventListener("change", toolChanged);
  $("edit-button").addEventListener("click", () => edit());
  window.addEventListener("beforeunload", (event) => { if (!isKept) event.preventDefault(); });
}
