// The camera path of films: views that are added, replaced, reordered and removed in a list, previewed, kept by the
// browser for this scene, and saved as JSON.

import * as api from "./api.js";
import { redraw } from "./drawing.js";
import { $, counted, make } from "./elements.js";
import { goTo, halt, play } from "./flights.js";
import { download } from "./saves.js";
import { failed, host, page, tell } from "./state.js";

const FORMAT = "hilsplat-path-1", FRAMES_PER_S = 24, MOST = 40;
let dragged = -1;

const key = () => `hilsplat path of ${page.scene.name}`;
const wired = () => page.path.map((view) => view.wire(host.clientWidth, host.clientHeight));

// The film's path and length, in the format of a request.
export const flown = () => ({ frames: FRAMES_PER_S * seconds(), ...($("path").value === "path" ? { path: wired() } : {}) });
const seconds = () => Math.min(20, Math.max(1, Math.round(Number($("seconds").value)) || 5));

function changed() {
  try { localStorage.setItem(key(), JSON.stringify(page.path.map((view) => page.scene.views[view.view]?.name ?? view.toText()))); } catch { /* a frame in another site's page may have no storage */ }
  const count = page.path.length, flies = $("path").querySelector("[value=path]");
  flies.disabled = count < 2;
  flies.textContent = `along your path (${counted(count, "view")})`;
  $("path").value = count < 2 ? "around" : "path";
  showPath();
  redraw();
}

function showPath() {
  $("path-section").hidden = !page.path.length;
  $("path-views").replaceChildren(...page.path.map((view, k) => {
    const act = (label, title, sign, work, disabled = false) => make("button", { type: "button", class: label, disabled, "aria-label": title, title, onclick: work }, sign);
    return make("li", { draggable: "true", ondragstart: () => { dragged = k; }, ondragover: (event) => { if (dragged >= 0) event.preventDefault(); },
      ondrop: (event) => { event.preventDefault(); move(dragged, k); }, ondragend: () => { dragged = -1; } },
    make("button", { type: "button", class: "words", title: "Go to this view", onclick: () => goTo(view.copy()) }, `View ${k + 1}`, make("small", {}, page.scene.views[view.view]?.name ?? "")),
    act("up", `Move view ${k + 1} up`, "↑", () => move(k, k - 1, "up"), !k), act("down", `Move view ${k + 1} down`, "↓", () => move(k, k + 1, "down"), k === page.path.length - 1),
    act("replace", `Replace view ${k + 1} by the current view`, "↺", () => { page.path[k] = page.camera.copy(); changed(); focusOn(k, "replace"); }),
    act("drop", `Remove view ${k + 1}`, "×", () => { page.path.splice(k, 1); changed(); focusOn(Math.min(k, page.path.length - 1), "drop"); }));
  }));
}

const focusOn = (k, name) => ($("path-views").children[k]?.querySelector(`.${name}:enabled`) ?? $("path-views").children[k]?.querySelector("button") ?? host).focus();

function move(from, to, name = "words") {
  if (from < 0 || from === to) return;
  page.path.splice(to, 0, ...page.path.splice(from, 1));
  changed();
  focusOn(to, name);
}

export function addToPath() {
  if (api.offline) return;
  if (page.path.length >= MOST) { tell(`A path has at most ${MOST} views: remove one first.`, true); return; }
  page.path.push(page.camera.copy());
  changed();
  tell(page.path.length < 2 ? "The path begins here. Add another view to make saved films follow the path." : `${counted(page.path.length, "view")} in the path. Saved films follow it.`);
}

let previews = 0;

function ended() { page.previewing = false; $("path-preview").textContent = "Preview"; }

// Move the camera as a saved film would; a second click, or moving the camera, ends it.
async function preview() {
  const mine = ++previews;
  if (page.previewing) { ended(); halt(); return; }
  page.previewing = true;
  $("path-preview").textContent = "Stop";
  try {
    const cameras = (await api.path(flown())).map((wire) => page.camera.ofView(wire));
    if (mine === previews) play(cameras, FRAMES_PER_S, ended);
  } catch (error) { if (mine === previews) ended(); failed(error); }
}

function saveJson() {
  const content = { format: FORMAT, scene: page.scene.name, frames_per_s: FRAMES_PER_S, frames: FRAMES_PER_S * seconds(), path: wired() };
  download(new Blob([JSON.stringify(content, null, 1)], { type: "application/json" }), `${page.scene.name.split("/").at(-1)}-path.json`);
}

async function openJson(file) {
  try {
    const { format, scene, frames, path } = JSON.parse(await file.text());
    if (format !== FORMAT) throw new Error();
    page.path = path.slice(0, MOST).map((wire) => page.camera.ofView(wire));
    $("seconds").value = Math.round(frames / FRAMES_PER_S);
    changed();
    if (scene !== page.scene.name) tell(`This path was saved for ${scene}, so its views may miss ${page.scene.name}.`, true);
  } catch { tell(`${file.name} is not a camera path: choose a file that “Save JSON” wrote.`, true); }
}

export function attachPath() {
  $("path-add").addEventListener("click", addToPath);
  $("path-more").addEventListener("click", addToPath);
  $("path-clear").addEventListener("click", () => { page.path = []; changed(); });
  $("path-preview").addEventListener("click", preview);
  $("path-save").addEventListener("click", saveJson);
  $("path-open").addEventListener("click", () => $("path-file").click());
  $("path-file").addEventListener("change", () => { if ($("path-file").files[0]) openJson($("path-file").files[0]); $("path-file").value = ""; });
}

// The path that this browser has kept for the scene.
export function restorePath() {
  let kept = [];
  try { kept = JSON.parse(localStorage.getItem(key()) ?? "[]"); } catch { /* no storage */ }
  page.path = kept.map((text) => {
    const number = page.scene.views.findIndex(({ name }) => name === text), camera = page.camera.copy();
    camera.fromText(number < 0 ? text : `v${number}`, page.scene.views);
    return camera;
  });
  if (page.path.length) changed();
}
