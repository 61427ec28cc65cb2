// Redraw the picture and its overlay after a change, and update the address that opens the same view.

import * as api from "./api.js";
import { $, counted, nameOf } from "./elements.js";
import { drawOverlay, inPicture } from "./overlay.js";
import { host, keptIn, level, levelIndex, main, options, outlines, page, panes, threshold, variantOf } from "./state.js";
import { LISTED, RAMP, shownHits, styleOf } from "./styles.js";

const SLOW_MS = 60, FRUSTUM = 0.08;   // depth of a drawn camera, in multiples of the photographs' mean distance
let dirty = true, styles = [], lastFrame = 0, frames = 0;

export const redraw = () => { dirty = true; requestAnimationFrame(paint); };
export const restyle = () => { styles = []; redraw(); };

export function currentStyles() {
  if (!styles.length) {
    styles = panes.map((pane, k) => {
      const own = !k || variantOf(pane) === variantOf(panes[0]);
      const style = styleOf({ outline: outlines.get(variantOf(pane)), answer: pane.answer, colour: $("colour").value, mode: $("mode").value, field: pane.field, threshold: threshold(), kept: keptIn(k),
        level: levelIndex(pane.answer), chosen: own ? page.chosen : -1, hover: own ? page.hover : -1 });
      return { ...style, marked: page.marked };
    });
  }
  return styles;
}

export const painted = () => currentStyles().map((style, k) => ({ variant: variantOf(panes[k]), style, removed: page.removed }));

function paint(now) {
  if (!dirty || !page.painter || !page.camera) return;
  dirty = false;
  if (page.moving) page.slow = now - lastFrame > SLOW_MS && now - lastFrame < 2000;
  lastFrame = now;
  const width = host.clientWidth, height = host.clientHeight;
  const scale = devicePixelRatio * (page.painter.kind === "gl" && page.moving && page.slow ? 0.5 : 1);
  page.painter.draw(page.camera, painted(), Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale)));
  overlay();
  if (page.painter.kind === "gl" && page.painter.settled) drawn();
}

export function overlay() {
  const width = host.clientWidth, height = host.clientHeight;
  drawOverlay($("overlay"), page.camera, panes.map((pane, k) => ({ boxes: boxes(pane, k), frustums: frustums(), label: panes.length > 1 ? pane.by.replace("|", ", ") : "" })), width, height, $("tools").offsetTop + $("tools").offsetHeight);
  showScale(currentStyles()[0]);
  const hits = shownHits(panes[0].answer), own = main(), each = width / panes.length;
  $("look").hidden = !hits.length || hits.some((hit) => inPicture(page.camera, own.nodes[hit.node].corners, each, height));
  page.photos.place(page.camera, width, height, panes.length);
  page.photos.mark(page.camera.view, page.asked?.shows ?? []);
}

// Show the relevancy colour bar, and the number of Gaussians at or above the threshold.
let shown = null;

function showScale(style) {
  const has = style.high !== undefined && Boolean(panes[0].answer);
  $("scale").hidden = !has;
  if (!has || style === shown) return;
  shown = style;
  const least = threshold(), bar = $("scale-bar"), context = bar.getContext("2d"), pixels = context.createImageData(256, 1);
  for (let i = 0; i < 256; i++) {
    const value = style.low + i / 255 * (style.high - style.low), below = least !== null && value < least;
    pixels.data.set(below ? [28, 28, 28, 255] : [...RAMP.subarray(3 * i, 3 * i + 3), 255], 4 * i);
  }
  context.putImageData(pixels, 0, 0);
  $("scale-low").textContent = style.low.toFixed(2);
  $("scale-high").textContent = style.high.toFixed(2);
  $("scale-told").textContent = least === null ? "" : `${counted(above(style, least), "Gaussian")} at or above ${least.toFixed(2)}`;
}

function above(style, least) {
  if (style.ramp) return panes[0].values.reduce((count, value) => count + (value >= 255 * least), 0);
  const answer = panes[0].answer, level = levelIndex(answer);
  return main().nodes.reduce((sum, node, row) => sum + (node.level === level && answer.relevancy[row] >= least ? node.gaussians : 0), 0);
}

// Cameras of the photographs, and views of the path.
function frustums() {
  const depth = FRUSTUM * page.scene.reach, photographs = page.frustums ? page.scene.views : [];
  return [...photographs.map((view, number) => ({ number, name: view.name, kind: view.split === "test" ? "frustum test" : "frustum", corners: page.camera.ofView(view).corners(depth) })),
    ...(page.previewing ? [] : page.path).map((camera, k) => ({ kind: "frustum path", label: String(k + 1), corners: camera.corners(depth) }))];
}

const labelOf = ({ name, called }, { score }, text = "") => [[...new Set([text, name || called].filter((words) => words && words !== "?"))].join(": "), score.toFixed(2)].filter(Boolean).join(" ");

function boxes(pane, k) {
  const own = outlines.get(variantOf(pane));
  if (!own || $("colour").value === "none") return [];
  const found = $("colour").value === "answers" ? keptIn(k).flatMap(({ answer, rgb, text }) => shownHits(answer).slice(0, LISTED).map((hit) => ({ node: hit.node, kind: "kept", stroke: `rgb(${rgb.join(" ")})`, label: labelOf(own.nodes[hit.node], hit, text) }))) : [];
  for (const hit of shownHits(pane.answer).slice(0, LISTED)) found.push({ node: hit.node, kind: "answer", label: labelOf(own.nodes[hit.node], hit) });
  if (!k || variantOf(pane) === variantOf(panes[0])) {
    if (page.chosen >= 0) found.push({ node: page.chosen, kind: "chosen", label: nameOf(own, page.chosen) });
    if (page.hover >= 0 && page.hover !== page.chosen) found.push({ node: page.hover, kind: "hover", label: nameOf(own, page.hover) });
  }
  const last = new Map();
  for (const box of found) {
    const before = last.get(box.node), both = before && ["kept", "answer"].includes(box.kind);
    last.set(box.node, both && before.label !== box.label ? { ...box, label: `${before.label} + ${box.label}` } : box);
  }
  return [...last.values()].map((box) => ({ ...box, corners: own.nodes[box.node].corners }));
}

export function drawn() {
  frames++;
  host.dataset.drawn = frames;
  if ($("loading").textContent && !$("loading").dataset.kept) $("loading").textContent = "";
  document.body.dataset.ready ||= "yes";
  remember();
}

// Return the part after # of the address that opens this view.
export function link() {
  const link = new URLSearchParams({ c: page.camera.toText() });
  const put = (key, value, usual) => { if (value && value !== usual) link.set(key, value); };
  for (const query of page.kept) link.append(query.shown ? "keep" : "hidden", JSON.stringify(query.asked));
  put("q", page.asked?.text); put("view", page.asked?.query?.view?.toString()); put("level", level(), "auto"); put("by", panes[0].by, `${page.scene.variants[0]}|tree`); put("beside", panes[1]?.by);
  put("node", page.chosen >= 0 ? `${page.chosen}.${main().tree}` : ""); put("colour", $("colour").value, "answers"); put("mode", $("mode").value, "tint"); put("least", threshold() === null ? "" : String(threshold()));
  return link;
}

// A new query is an entry in the browser's history, so Back returns to the previous query.
let remembering = 0, remembered = null;
export const rememberedAs = (text) => { remembered = text; };
function remember() {
  clearTimeout(remembering);
  remembering = setTimeout(() => {
    const text = page.asked?.text ?? "", isNew = remembered !== null && text && text !== remembered;
    remembered = text || remembered || "";
    history[isNew ? "pushState" : "replaceState"]({}, "", `${location.pathname}${api.offline ? location.search : keptSearch()}#${link()}`);
  }, 400);
}
function keptSearch() {
  if (options.has("embedded")) return location.search;
  const kept = new URLSearchParams([...options].filter(([key, value]) => ["scene", "painter"].includes(key) && value));
  return `${kept}` && `?${kept}`;
}
