// Queries with a text, a node, a picture or a part of the view; each is sent for every pane.

import { markChosen, showAnswers, summary } from "./answers.js";
import * as api from "./api.js";
import { acts, choose, paneAt } from "./choosing.js";
import { overlay, redraw, restyle } from "./drawing.js";
import { $, nameOf, shape } from "./elements.js";
import { asking, keep, showKept, whenReopened } from "./kept.js";
import { answererOf, failed, level, main, outlines, page, panes, setQuery, tell, variantOf } from "./state.js";
import { base64, styleOf } from "./styles.js";

const PICTURE_PX = 512;
let aborting = new AbortController();

// Abort the previous query, and return the signal that aborts the new one.
function begin() {
  aborting.abort();
  aborting = new AbortController();
  return aborting.signal;
}

async function askAll(what, work) {
  const signal = begin();
  tell("…");
  try {
    for (const [k, pane] of panes.entries()) {
      if (!outlines.has(variantOf(pane))) continue;
      const answer = await work(pane, signal);
      if (signal.aborted) return;
      Object.assign(pane, { answer, field: null });
      if (!k) answered(what, answer);
      else listAnswers();
    }
  } catch (error) { refused(error); return; }
  await fillField();
}

// Remove the previous answer, so that it isn't mistaken for the new query's answer.
function refused(error) {
  if (error.name === "AbortError") return;
  showNothing();
  failed(error);
}

function answered(what, answer) {
  page.asked = { ...what, shows: answer.best_views };
  tell(`${what.alike ? `Like ${what.alike}: ` : ""}${summary(answer)}`);
  listAnswers();
  page.outline.answered(answer.hits.map((hit) => hit.node));
  page.photos.reveal(page.asked.shows);
  markChosen(page.chosen);
  showKept();
}

export function listAnswers() {
  const right = panes[1];
  showAnswers(main(), panes[0].answer, acts, right && { outline: outlines.get(variantOf(right)), answer: right.answer, by: right.by.replace("|", ", ") });
  restyle();   // names in the list are also those of labels
}

export async function fillField() {
  const { signal } = aborting;   // of the last query, after which relevancy of an earlier text is of no use
  if ($("colour").value === "field" && page.asked?.text) {
    const field = { text: page.asked.text.split(">").at(-1).trim(), level: level() };
    try {
      for (const pane of panes) {
        if (pane.field || !pane.answer) continue;
        pane.values = new Uint8Array(await api.field({ variant: variantOf(pane), ...field }, signal));
        page.painter.loadField(variantOf(pane), pane.values);
        pane.field = field;
      }
    } catch (error) { failed(error); }
  }
  restyle();
}

// Send the query of a link, if it has one.
export async function askAs(link) {
  $("text").value = link.get("q") ?? "";
  if ($("text").value) await ask(false, link.has("view") ? Number(link.get("view")) : null);
}

// view: number of the photograph that restricts the answers, if it isn't the present one.
export async function ask(keepChoice = false, view = null) {
  const text = $("text").value.trim();
  if (!text) { clearAnswer(); return; }
  if (!main()) {   // the nodes are still loading, or do not exist yet
    page.waiting = true;
    tell("Your query runs as soon as the semantic tree is loaded.");
    return;
  }
  if ($("here").checked && view === null && page.camera.view < 0) { refused(new Error("Go to a photograph first: choose one below.")); return; }
  if (!keepChoice && page.chosen >= 0) choose(-1);   // without a choice, the view is drawn only with the answer
  const asked = { ...asking(text), ...(view === null ? {} : { view }) };
  await askAll({ text, query: asked }, (pane, signal) => api.query({ variant: variantOf(pane), answerer: answererOf(pane), ...asked }, signal));
}

// Keep the current answer in its own colour and empty the text box.
export async function keepAnswer() {
  const asked = page.asked?.query;
  if (!asked || !panes[0].answer?.hits.length) { tell("Run a query to keep its answer."); return; }
  if (!await keep(asked) || page.asked?.query !== asked) return;   // another query may have been run meanwhile
  clearAnswer();
  tell(`Kept “${asked.text}”. You can run another query.`);
  $("text").focus();
}

whenReopened((asked) => {
  if (asked.view !== undefined) page.camera.standAt(page.scene.views[asked.view], asked.view);
  setQuery(asked);
  $("text").value = asked.text;
  ask();
});

export async function like(node) {
  if (node < 0 || api.offline) return;
  $("text").value = "";
  await askAll({ alike: nameOf(main(), node) }, (pane, signal) => outlines.get(variantOf(pane)).tree === main().tree ? api.like({ variant: variantOf(pane), node }, signal) : null);   // another tree has other nodes
}

// Query with a picture, which may be a promise, or with its part [x, y, width, height], px.
export async function askPicture(source, part = null) {
  const signal = begin();
  try {
    const image = await createImageBitmap(await source), [x, y, w, h] = part ?? [0, 0, image.width, image.height];
    const scale = Math.min(1, PICTURE_PX / Math.max(w, h)), canvas = new OffscreenCanvas(Math.max(1, Math.round(w * scale)), Math.max(1, Math.round(h * scale)));
    canvas.getContext("2d").drawImage(image, x, y, w, h, 0, 0, canvas.width, canvas.height);
    const bytes = new Uint8Array(await (await canvas.convertToBlob({ type: "image/jpeg", quality: 0.9 })).arrayBuffer());
    if (signal.aborted) return;
    $("text").value = "";
    choose(-1);
    await askAll({}, (pane, signal) => api.like({ variant: variantOf(pane), picture: base64(bytes) }, signal));
  } catch (error) { if (!signal.aborted) refused(error); }
}

// Query with the framed part of the photograph, or of the rendered picture.
export async function framed(points, done) {
  const [from, to] = [points[0], points.at(-1)], [x0, x1] = [from[0], to[0]].sort((a, b) => a - b), [y0, y1] = [from[1], to[1]].sort((a, b) => a - b);
  overlay();
  $("overlay").append(shape("path", { class: "hover", d: `M${x0} ${y0}H${x1}V${y1}H${x0}Z` }));
  if (!done || x1 - x0 < 6 || y1 - y0 < 6 || api.offline) return;
  const { k, width, height } = paneAt(x0), left = x0 - k * width;
  if (page.camera.view >= 0) {
    const { s, x, y } = page.camera.frame(width, height);
    await askPicture(api.photo(page.camera.view), [(left - x) / s, (y0 - y) / s, (x1 - x0) / s, (y1 - y0) / s]);
  } else {
    const plain = [{ variant: "", style: styleOf({ outline: null, colour: "none", mode: "plain", chosen: -1, hover: -1 }), removed: page.removed }];
    await askPicture(page.painter.capture(page.camera, plain, Math.round(width), height), [left, y0, x1 - x0, y1 - y0]);
    redraw();
  }
}

export function clearAnswer() {
  aborting.abort();
  $("text").value = "";
  tell("");
  showNothing();
}

function showNothing() {
  page.asked = null;
  for (const pane of panes) Object.assign(pane, { answer: null, field: null });
  showAnswers(main(), null, {});
  page.outline.answered([]);
  showKept();
}

export function clear() {
  if (page.chosen >= 0) choose(-1); else clearAnswer();
}

acts.like = like;
acts.list = listAnswers;
