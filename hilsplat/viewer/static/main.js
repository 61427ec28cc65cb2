// The page: what is asked, what is chosen, where the camera is; everything else is drawn from that.

import * as api from "./api.js";
import { markChosen, showAnswers, summary } from "./answers.js";
import { Camera } from "./camera.js";
import { children, showCard } from "./card.js";
import { attach } from "./controls.js";
import { $, counted, LEVELS, make, nameOf } from "./elements.js";
import { attachKeys } from "./keyboard.js";
import { latest } from "./latest.js";
import { Outline } from "./outline.js";
import { drawOverlay } from "./overlay.js";
import { Photos } from "./photos.js";
import { describe, Renderer } from "./renderer.js";
import { save } from "./saves.js";
import { ServerPainter } from "./server_painter.js";
import { styleOf } from "./styles.js";

const PICTURE_PX = 512, SLOW_MS = 60, POLL_MS = 5000, MODES = ["tint", "ghost", "isolate", "plain"];

const host = $("view"), options = new URLSearchParams(location.search);
const start = new URLSearchParams(location.hash.slice(1));
const calm = matchMedia("(prefers-reduced-motion: reduce)");
let scene, camera, painter, photos, outline;
let chosen = -1, hover = -1, asked = null, dirty = true, moving = false, slow = false, styles = [], lastFrame = 0, frames = 0, flight = 0;
const outlines = new Map();                             // by variant
const panes = [{ by: "", answer: null, field: false }]; // one, or two side by side

const variantOf = (pane) => pane.by.split("|")[0];
const answererOf = (pane) => pane.by.split("|")[1] || "tree";
const level = () => document.querySelector("[name=level]:checked").value;
const levelIndex = (answer) => Math.max(0, LEVELS.indexOf(level() === "auto" ? answer?.level ?? "whole" : level()));
const main = () => outlines.get(variantOf(panes[0]));

function tell(text, error = false) { $("status").textContent = text; $("status").classList.toggle("error", error); }
const failed = (error) => { if (error.name !== "AbortError") tell(error.message, true); };
const redraw = () => { dirty = true; requestAnimationFrame(paint); };
const restyle = () => { styles = []; redraw(); };

// -- drawing ---------------------------------------------------------------------------------------

function currentStyles() {
  if (!styles.length) {
    styles = panes.map((pane, k) => {
      const own = !k || variantOf(pane) === variantOf(panes[0]);
      return styleOf({ outline: outlines.get(variantOf(pane)), answer: pane.answer, colour: $("colour").value, mode: $("mode").value, hasField: pane.field,
        level: levelIndex(pane.answer), chosen: own ? chosen : -1, hover: own ? hover : -1 });
    });
  }
  return styles;
}

const painted = () => currentStyles().map((style, k) => ({ variant: variantOf(panes[k]), style }));

function paint(now) {
  if (!dirty || !painter || !camera) return;
  dirty = false;
  if (moving) slow = now - lastFrame > SLOW_MS && now - lastFrame < 2000;
  lastFrame = now;
  const width = host.clientWidth, height = host.clientHeight;
  const scale = devicePixelRatio * (painter.kind === "gl" && moving && slow ? 0.5 : 1);
  painter.draw(camera, painted(), Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale)));
  overlay();
  if (painter.kind === "gl" && painter.settled) drawn();
}

function overlay() {
  const width = host.clientWidth, height = host.clientHeight;
  drawOverlay($("overlay"), camera, panes.map((pane, k) => ({ boxes: boxes(pane, k), label: panes.length > 1 ? pane.by.replace("|", ", ") : "" })), width, height);
  photos.place(camera, width, height, panes.length);
  photos.mark(camera.view, asked?.shows ?? []);
}

function boxes(pane, k) {
  const own = outlines.get(variantOf(pane));
  if (!own || $("colour").value === "none") return [];
  const found = (pane.answer?.route === "like" ? pane.answer.hits.slice(0, 5) : pane.answer?.hits ?? [])
    .map((hit) => ({ node: hit.node, kind: "answer", label: `${own.nodes[hit.node].name || ""} ${hit.score.toFixed(2)}`.trim() }));
  if (!k || variantOf(pane) === variantOf(panes[0])) {
    if (chosen >= 0) found.push({ node: chosen, kind: "chosen", label: nameOf(own, chosen) });
    if (hover >= 0 && hover !== chosen) found.push({ node: hover, kind: "hover", label: nameOf(own, hover) });
  }
  const last = new Map(found.map((box) => [box.node, box]));
  return [...last.values()].map((box) => ({ ...box, corners: own.nodes[box.node].corners }));
}

function drawn() {
  frames++;
  host.dataset.drawn = frames;
  if ($("loading").textContent && !$("loading").dataset.kept) $("loading").textContent = "";
  if (!document.body.dataset.ready) {
    document.body.dataset.ready = "yes";
    performance.mark("first-frame");
  }
  remember();
}

let remembering = 0;
function remember() {
  clearTimeout(remembering);
  remembering = setTimeout(() => {
    const link = new URLSearchParams({ c: camera.toText() });
    const put = (key, value, usual) => { if (value && value !== usual) link.set(key, value); };
    put("q", asked?.text); put("level", level(), "auto"); put("by", panes[0].by, `${scene.variants[0]}|tree`); put("beside", panes[1]?.by);
    put("node", chosen >= 0 ? String(chosen) : ""); put("colour", $("colour").value, "answers"); put("mode", $("mode").value, "tint");
    history.replaceState(null, "", `${location.pathname}${api.offline ? location.search : keptSearch()}#${link}`);
  }, 400);
}
const keptSearch = () => options.get("painter") ? `?painter=${options.get("painter")}` : "";

// -- the camera ------------------------------------------------------------------------------------

function setMoving(now) {
  if (moving === now) return;
  moving = now;
  if (painter) painter.moving = now;
  if (!now) redraw();
}

const touched = () => { flight++; setMoving(true); redraw(); };

function goTo(target) {
  const mine = ++flight;
  if (calm.matches || painter.kind === "server" || slow) { camera = target; setMoving(false); redraw(); return; }
  const from = camera.copy(), begin = performance.now(), lasts = 450;
  setMoving(true);
  const step = (now) => {
    if (mine !== flight) return;
    const t = Math.min(1, Math.max(0, (now - begin) / lasts)), eased = t * t * (3 - 2 * t);
    camera = t < 1 ? from.between(target, eased) : target;
    if (t < 1) requestAnimationFrame(step); else setMoving(false);
    redraw();
  };
  requestAnimationFrame(step);
}

function stand(number) {
  const target = camera.copy();
  target.standAt(scene.views[number], number);
  goTo(target);
}

const flyTo = (node) => {
  if (node < 0 || !main()) return;
  const { centroid, size } = main().nodes[node];
  goTo(camera.lookingAt(centroid, Math.max(...size)));
};

// -- choosing --------------------------------------------------------------------------------------

function choose(node) {
  chosen = node;
  hover = -1;
  markChosen(node);
  if (main()) showCard(main(), node, scene.unit === "metre" ? " m" : "", { choose, like, hover: setHover, fly: () => flyTo(chosen), name: rename });
  outline.select(node);   // after the card, which takes room from the outline
  restyle();
}

function setHover(node) {
  if (node === hover) return;
  hover = node;
  restyle();
}

function paneAt(x) {
  const each = host.clientWidth / panes.length, k = Math.min(panes.length - 1, Math.floor(x / each));
  return { k, x: x - k * each, width: each, height: host.clientHeight };
}

const exactPick = async (at, y) => {
  const { nodes } = await api.pick({ variant: variantOf(panes[at.k]), camera: camera.wire(at.width, at.height), x: at.x, y });
  return nodes.map(([node]) => node);
};
const quickPick = (at, y) => painter.nodesAt(variantOf(panes[at.k]), painter.gaussianAt(camera, painted()[at.k], at.x, y, at.width, at.height));

// A click chooses the whole; a click on what is chosen goes one level down, and from the finest up again.
function deeper(nodes) {
  const fixed = LEVELS.indexOf(level());
  if (fixed >= 0) return [...nodes.slice(0, fixed + 1)].reverse().find((node) => node >= 0) ?? -1;
  const there = nodes.filter((node) => node >= 0), at = there.indexOf(chosen);
  return there[(at + 1) % Math.max(there.length, 1)] ?? -1;
}

async function tapped(x, y) {
  host.focus({ preventScroll: true });
  const at = paneAt(x);
  if (!outlines.get(variantOf(panes[at.k])) || variantOf(panes[at.k]) !== variantOf(panes[0])) return;
  try { choose(deeper(api.offline ? quickPick(at, y) : await exactPick(at, y))); } catch (error) { failed(error); }
}

const hoverAt = latest(async (x, y) => {
  if (x < 0 || moving || !main()) { setHover(-1); return; }
  const at = paneAt(x);
  if (variantOf(panes[at.k]) !== variantOf(panes[0])) return;
  try {
    const nodes = painter.kind === "gl" ? quickPick(at, y) : await exactPick(at, y);
    const fixed = LEVELS.indexOf(level()), there = nodes.filter((node) => node >= 0);
    setHover(fixed >= 0 ? deeper(nodes) : there.includes(chosen) ? deeper(nodes) : there[0] ?? -1);
  } catch { setHover(-1); }
});
let pointing = 0;
const pointed = (x, y) => { clearTimeout(pointing); pointing = setTimeout(() => hoverAt(x, y), painter?.kind === "gl" && !slow ? 16 : 60); };

async function rename(node, name) {
  const own = main(), names = {};
  own.nodes.forEach((each, row) => { if (each.name) names[row] = each.name; });
  names[node] = name;
  try {
    const kept = await api.names({ variant: own.variant, names }, own.version);
    for (const each of outlines.values()) if (each.tree === own.tree) {
      each.version = kept.version;
      each.nodes.forEach((entry, row) => { entry.name = kept.names[row] ?? ""; });
    }
    outline.renamed(node);
    choose(node);
    if (panes[0].answer) showAnswers(own, panes[0].answer, { choose, hover: setHover });
    tell(name ? `Named “${name}”. Ask for it, here or with hilsplat query.` : "The name is taken away.");
  } catch (error) {
    if (error.status === 412) { await loadVariant(own.variant, true); outline.show(main()); choose(node); tell("Somebody else changed the names meanwhile; they are here now. Name it again.", true); } else failed(error);
  }
}

// -- asking ----------------------------------------------------------------------------------------

let aborting = new AbortController();

async function askAll(what, work) {
  aborting.abort();
  aborting = new AbortController();
  const signal = aborting.signal;
  tell("…");
  try {
    for (const [k, pane] of panes.entries()) {
      if (!outlines.has(variantOf(pane))) continue;
      const answer = await work(pane, signal);
      if (signal.aborted) return;
      Object.assign(pane, { answer, field: false });
      if (!k) answered(what, answer);
    }
    await fillField(signal);
    restyle();
  } catch (error) { failed(error); }
}

function answered(what, answer) {
  asked = { ...what, shows: answer.hits[0]?.best_views ?? [] };
  tell(summary(answer));
  showAnswers(main(), answer, { choose, hover: setHover });
  outline.answered(answer.hits.map((hit) => hit.node));
  markChosen(chosen);
  restyle();
}

async function fillField(signal) {
  if ($("colour").value !== "field" || !asked?.text) return;
  for (const pane of panes) {
    if (pane.field || !pane.answer) continue;
    const bytes = new Uint8Array(await api.field({ variant: variantOf(pane), text: asked.text.split(">").at(-1).trim(), level: level() }, signal));
    painter.loadValues(variantOf(pane), bytes);
    pane.field = true;
  }
  restyle();
}

async function ask(keepChoice = false) {
  const text = $("text").value.trim();
  if (!text) { clearAnswer(); return; }
  const view = $("here").checked ? camera.view : -1;
  if ($("here").checked && view < 0) { tell("Stand at a photograph first: choose one below.", true); return; }
  if (!keepChoice) choose(-1);
  await askAll({ text }, (pane, signal) => api.query({ variant: variantOf(pane), text, level: level(), answerer: answererOf(pane), ...(view >= 0 ? { view } : {}) }, signal));
}

async function like(node) {
  if (node < 0 || api.offline) return;
  $("text").value = "";
  const name = nameOf(main(), node);
  await askAll({}, (pane, signal) => api.like({ variant: variantOf(pane), node: variantOf(pane) === variantOf(panes[0]) ? node : 0 }, signal));
  tell(`Like ${name}: ${$("status").textContent}`);
}

// A picture, or a part of one: [x, y, width, height] in its pixels.
async function askPicture(source, part = null) {
  try {
    const image = await createImageBitmap(source), [x, y, w, h] = part ?? [0, 0, image.width, image.height];
    const scale = Math.min(1, PICTURE_PX / Math.max(w, h)), canvas = new OffscreenCanvas(Math.max(1, Math.round(w * scale)), Math.max(1, Math.round(h * scale)));
    canvas.getContext("2d").drawImage(image, x, y, w, h, 0, 0, canvas.width, canvas.height);
    const bytes = new Uint8Array(await (await canvas.convertToBlob({ type: "image/jpeg", quality: 0.9 })).arrayBuffer());
    let text = "";
    for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
    $("text").value = "";
    choose(-1);
    await askAll({}, (pane, signal) => api.like({ variant: variantOf(pane), picture: btoa(text) }, signal));
  } catch (error) { failed(error); }
}

// A frame drawn over the view: its part of the photograph, or of what is drawn.
async function framed(from, to, done) {
  const [x0, x1] = [from[0], to[0]].sort((a, b) => a - b), [y0, y1] = [from[1], to[1]].sort((a, b) => a - b);
  overlay();
  const svg = $("overlay"), path = document.createElementNS(svg.namespaceURI, "path");
  path.setAttribute("class", "hover");
  path.setAttribute("d", `M${x0} ${y0}H${x1}V${y1}H${x0}Z`);
  svg.append(path);
  if (!done || x1 - x0 < 6 || y1 - y0 < 6 || api.offline) return;
  if (camera.view >= 0) {
    const photo = await (await fetch(api.photoUrl(camera.view))).blob(), { s, x, y } = camera.frame(host.clientWidth / panes.length, host.clientHeight);
    await askPicture(photo, [(x0 - x) / s, (y0 - y) / s, (x1 - x0) / s, (y1 - y0) / s]);
  } else {
    const plain = [{ variant: "", style: styleOf({ outline: null, colour: "none", mode: "plain", chosen: -1, hover: -1 }) }];
    await askPicture(await painter.capture(camera, plain, host.clientWidth, host.clientHeight), [x0, y0, x1 - x0, y1 - y0]);
    redraw();
  }
}

function clearAnswer() {
  aborting.abort();
  asked = null;
  for (const pane of panes) Object.assign(pane, { answer: null, field: false });
  $("text").value = "";
  tell("");
  showAnswers(main(), null, {});
  outline.answered([]);
  restyle();
}

function clear() {
  $("save").open = false;
  if (chosen >= 0) choose(-1); else clearAnswer();
}

// -- loading ---------------------------------------------------------------------------------------

async function loadVariant(name, again = false) {
  if (outlines.has(name) && !again) return;
  const [described, nodes] = await Promise.all([api.variant(name), again ? null : api.nodes(name)]);
  if (nodes) painter.loadNodes(name, nodes);
  outlines.set(name, described);
}

function fillVariants() {
  const choices = scene.variants.flatMap((name) => [[`${name}|tree`, `${name}, tree`], [`${name}|field`, `${name}, field`]]);
  const fill = (select, kept, more) => {
    select.replaceChildren(...more, ...choices.map(([value, text]) => make("option", { value }, text)));
    select.value = kept;
  };
  fill($("left"), panes[0].by, []);
  fill($("right"), panes[1]?.by ?? "", [make("option", { value: "" }, "nothing")]);
  $("left").disabled = $("right").disabled = api.offline || !choices.length;
}

async function useVariants() {
  const known = (by) => scene.variants.includes(by?.split("|")[0]) ? by : null;
  panes[0].by = known(start.get("by")) ?? `${scene.variants[0]}|tree`;
  const beside = known(start.get("beside"));
  if (beside && !api.offline) panes[1] = { by: beside, answer: null, field: false };
  for (const pane of panes) await loadVariant(variantOf(pane));
  fillVariants();
  showOutline();
  if (start.get("q")) { $("text").value = start.get("q"); await ask(); }
  const node = Number(start.get("node") ?? -1);
  if (node >= 0 && node < main().nodes.length) choose(node);
}

function showOutline() {
  outline.show(main());
  showAnswers(main(), panes[0].answer, { choose, hover: setHover });
  $("about").textContent = `${scene.name}: ${counted(scene.gaussians, "Gaussian")}. Masks by ${main().masks}, words and pictures by ${main().clip}.`;
  restyle();
}

async function choosePanes() {
  try {
    const left = $("left").value, right = $("right").value, changed = left.split("|")[0] !== variantOf(panes[0]);
    panes[0] = left === panes[0].by ? panes[0] : { by: left, answer: null, field: false };
    if (!right) panes.length = 1;
    else if (panes[1]?.by !== right) panes[1] = { by: right, answer: null, field: false };
    for (const pane of panes) await loadVariant(variantOf(pane));
    if (changed) { choose(-1); showOutline(); }
    if (asked?.text) await ask(true); else restyle();
    redraw();
  } catch (error) { failed(error); }
}

async function answersLater() {   // while the run goes
  try { scene.variants = (await api.scene()).variants; } catch { return; }
  if (!scene.variants.length) { setTimeout(answersLater, POLL_MS); return; }
  try { tell("Answers are ready."); await useVariants(); } catch (error) { failed(error); }
}

function choosePainter(gl) {
  const wanted = options.get("painter") || (!gl.works || (gl.software && !api.offline) ? "server" : "gl");
  host.dataset.gl = gl.name;
  if (wanted === "server" && !api.offline) return serverPainter();
  host.dataset.painter = "gl";
  return new Renderer(host, redraw);
}

function serverPainter() {
  host.dataset.painter = "server";
  return new ServerPainter(host, () => { overlay(); if (painter.settled) drawn(); }, failed);
}

async function begin() {
  $("loading").textContent = "Loading…";
  scene = await api.scene();
  document.title = `${scene.name} · hilsplat`;
  $("title").textContent = `Ask ${scene.name.split("/").at(-1)}`;
  camera = new Camera(scene);
  if (start.get("c")) camera.fromText(start.get("c"), scene.views);
  photos = new Photos(scene.views, stand);
  outline = new Outline({ choose, fly: () => flyTo(chosen), hover: setHover });
  for (const [id, key] of [["colour", "colour"], ["mode", "mode"]]) if ([...$(id).options].some((o) => o.value === start.get(key))) $(id).value = start.get(key);
  const radio = [...document.querySelectorAll("[name=level]")].find((each) => each.value === start.get("level"));
  if (radio) radio.checked = true;
  let made = choosePainter(describe());
  if (made.kind === "gl") {
    try { await made.load(await api.splats()); } catch (error) {
      if (api.offline) throw error;
      made.canvas.remove();
      tell(`${error.message}: the server draws instead.`);
      made = serverPainter();
    }
  }
  painter = made;
  redraw();
  if (api.offline) onlyWhatIsHere();
  if (scene.variants.length) {
    try { await useVariants(); } catch (error) { tell(`There are no answers: ${error.message}`, true); }   // the Gaussians can still be looked at
  } else {
    fillVariants();
    $("about").textContent = `${scene.name}: ${counted(scene.gaussians, "Gaussian")}.`;
    tell("The run goes on: you can look around; questions will be answered when the semantic tree is there.");
    setTimeout(answersLater, POLL_MS);
  }
}

// An exported page has no server: it answers the texts that it was made with.
function onlyWhatIsHere() {
  for (const element of [$("picture-button"), $("here").parentElement, $("left").parentElement, $("right").parentElement]) element.hidden = true;
  for (const button of $("save").querySelectorAll("[data-save]:not([data-save=still])")) button.hidden = true;
  $("save").querySelector("hr").hidden = true;
  $("colour").querySelector("[value=field]").remove();
  $("levels").hidden = true;
  $("text").setAttribute("list", "texts");
  document.body.append(make("datalist", { id: "texts" }, ...api.texts.map((text) => make("option", { value: text }))));
  if (api.texts.length) tell(`This page answers: ${api.texts.join(", ")}.`);
}

// -- hands -----------------------------------------------------------------------------------------

const rested = () => setMoving(false);
const touch = attach(host, { camera: () => camera, changed: touched, rested, tapped, pointed, framed });
const nudge = (work) => { work(); touch(); };
const step = (by) => {
  const count = scene.views.length, from = camera.view;
  stand(from < 0 ? nearestView() : (from + by + count) % count);
};

function nearestView() {
  let best = 0, least = Infinity;
  scene.views.forEach((view, number) => {
    const other = camera.copy();
    other.standAt(view, number);
    const away = Math.hypot(...other.c.map((v, k) => v - camera.c[k])) + scene.reach * (1 - other.R[2].reduce((sum, v, k) => sum + v * camera.R[2][k], 0));
    if (away < least) { least = away; best = number; }
  });
  return best;
}

const setLevel = (value) => { document.querySelector(`[name=level][value=${value}]`).checked = true; levelChanged(); };
const levelChanged = () => { if (asked?.text && !api.offline) ask(true); else restyle(); };

attachKeys({
  ask: () => { $("text").focus(); $("text").select(); },
  clear, step, help: () => $("help").showModal(),
  zoom: (factor) => nudge(() => camera.zoom(factor)), orbit: (x, y) => nudge(() => camera.orbit(0.1 * x, 0.1 * y)),
  move: (x, y, z) => nudge(() => camera.move(0.06 * x, 0.06 * y, 0.06 * z)),
  photo: () => $("blend").click(), fly: () => flyTo(chosen), like: () => like(chosen), level: setLevel,
  name: () => $("card").querySelector(".name")?.focus(),
  mode: () => { $("mode").value = MODES[(MODES.indexOf($("mode").value) + 1) % MODES.length]; restyle(); },
  parent: () => { if (chosen >= 0 && main().nodes[chosen].parent >= 0) choose(main().nodes[chosen].parent); },
  child: () => { if (chosen >= 0 && children(main(), chosen).length) choose(children(main(), chosen)[0]); },
});

$("ask").addEventListener("submit", (event) => { event.preventDefault(); ask(); });
$("text").addEventListener("search", () => { if (!$("text").value && asked?.text) clearAnswer(); });
for (const radio of document.querySelectorAll("[name=level]")) radio.addEventListener("change", levelChanged);
for (const id of ["left", "right"]) $(id).addEventListener("change", choosePanes);
$("mode").addEventListener("change", restyle);
$("colour").addEventListener("change", async () => { try { await fillField(); } catch (error) { failed(error); } restyle(); });
$("blend").addEventListener("click", () => { if (camera.view < 0) stand(nearestView()); photos.cycle(); redraw(); });
$("help-button").addEventListener("click", () => $("help").showModal());
$("picture-button").addEventListener("click", () => $("picture").click());
$("picture").addEventListener("change", () => { if ($("picture").files[0]) askPicture($("picture").files[0]); $("picture").value = ""; });
document.addEventListener("paste", (event) => { const file = [...event.clipboardData.files].find((each) => each.type.startsWith("image/")); if (file) askPicture(file); });
host.addEventListener("dragover", (event) => event.preventDefault());
host.addEventListener("drop", (event) => { event.preventDefault(); const file = event.dataTransfer.files[0]; if (file?.type.startsWith("image/")) askPicture(file); });
new ResizeObserver(redraw).observe(host);

const selected = () => chosen >= 0 ? [chosen] : (panes[0].answer?.hits ?? []).map((hit) => hit.node);
$("save").addEventListener("toggle", () => {
  const nodes = selected();
  $("save-what").textContent = chosen >= 0 ? `Of ${nameOf(main(), chosen)}` : nodes.length ? `Of ${counted(nodes.length, "answer")}` : "Ask or choose something to save its Gaussians, boxes and masks.";
  for (const button of $("save").querySelectorAll("[data-nodes]")) button.disabled = !nodes.length;
});
$("save").addEventListener("click", async (event) => {
  const kind = event.target.closest("[data-save]")?.dataset.save;
  if (!kind) return;
  $("save").open = false;
  try {
    if (kind === "link") { await navigator.clipboard.writeText(location.href); tell("The link is copied. It opens this view while this viewer runs."); return; }
    const scale = devicePixelRatio, size = [Math.round(host.clientWidth * scale), Math.round(host.clientHeight * scale)];
    await save(kind, { variant: variantOf(panes[0]), nodes: selected(), style: currentStyles()[0], capture: () => painter.capture(camera, painted(), ...size),
      texts: asked?.text ? [asked.text] : [], camera: camera.wire(host.clientWidth, host.clientHeight), name: scene.name.split("/").at(-1), told: tell });
    redraw();
  } catch (error) { failed(error); }
});

// What tests and benchmarks read.
globalThis.hilsplat = {
  get camera() { return camera; }, get painter() { return painter; }, painted, redraw, quickPick: (x, y) => quickPick(paneAt(x), y),
  pixels: () => ({ width: host.clientWidth, height: host.clientHeight, data: Array.from(painter.pixels(camera, painted(), host.clientWidth, host.clientHeight)) }),
};

begin().catch((error) => { $("loading").textContent = error.message; $("loading").dataset.kept = "yes"; document.body.dataset.ready = "failed"; });
