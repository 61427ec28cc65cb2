// Start of the page: load the scene, choose a painter for this browser, and load the variants that exist.

import * as api from "./api.js";
import { Camera } from "./camera.js";
import { acts, paneAt, quickPick } from "./choosing.js";
import { restoreRemoved } from "./editing.js";
import { drawn, overlay, painted, redraw } from "./drawing.js";
import { $, counted, make } from "./elements.js";
import { stand } from "./flights.js";
import { attachHands } from "./hands.js";
import { Outline } from "./outline.js";
import { restorePath } from "./path.js";
import { Photos } from "./photos.js";
import { describe, Renderer } from "./renderer.js";
import { ServerPainter } from "./server_painter.js";
import { failed, host, openLink, options, page, start, tell } from "./state.js";
import { fillVariants, useVariants, watch } from "./variants.js";

function choosePainter(gl) {
  const wanted = options.get("painter") || (!gl.works || (gl.software && !api.offline) ? "server" : "gl");
  host.dataset.gl = gl.name;
  if (wanted === "server" && !api.offline) return serverPainter();
  host.dataset.painter = "gl";
  return new Renderer(host, redraw, lost);
}

function lost() {
  if (api.offline) { tell("The graphics card was reset: reload the page.", true); return; }
  page.painter = insteadOf(page.painter, "The graphics card was reset");
  redraw();
}

function insteadOf(painter, why) {
  painter?.canvas.remove();
  tell(`${why}, so the server renders the scene.`);
  return serverPainter();
}

function serverPainter() {
  host.dataset.painter = "server";
  return new ServerPainter(host, () => { overlay(); if (page.painter.settled) drawn(); }, failed);
}

async function begin() {
  $("loading").textContent = "Loading…";
  page.scene = await api.scene();
  document.title = `${page.scene.name} · hilsplat`;
  $("title").textContent = `Query ${page.scene.name.split("/").at(-1)}`;
  page.camera = new Camera(page.scene);
  page.photos = new Photos(page.scene.views, stand);
  page.outline = new Outline(acts);
  if (!api.offline) restorePath();
  openLink(start);
  let made = choosePainter(describe());
  if (made.kind === "gl") {
    try { await made.load(page.scene, api.splats, arriving); } catch (error) {
      if (api.offline) throw error;
      console.warn(error);
      made = insteadOf(made, error.message);
    }
  }
  page.painter = made;
  if (!api.offline) restoreRemoved();
  redraw();
  if (api.offline) onlyWhatIsHere();
  if (page.scene.variants.length) {
    try { await useVariants(); } catch (error) { tell(`Queries are not available: ${error.message}`, true); }   // the Gaussians can still be viewed
  } else {
    fillVariants();
    $("about").textContent = `${page.scene.name}: ${counted(page.scene.gaussians, "Gaussian")}.`;
    tell("The run is not finished. You can query the scene once the semantic tree exists.");
  }
  if (!api.offline) watch();
  await page.painter.loaded;
}

function arriving(here, chunks) { Object.assign($("arriving"), { value: here, max: chunks, hidden: here === chunks }); }

// Hide what needs a server (`data-server`): an exported page has only its stored answers.
function onlyWhatIsHere() {
  for (const element of document.querySelectorAll("[data-server]")) element.hidden = true;
  $("colour").querySelector("[value=field]").remove();
  $("text").setAttribute("list", "texts");
  document.body.append(make("datalist", { id: "texts" }, ...api.texts.map((text) => make("option", { value: text }))));
  $("text").placeholder = api.texts[0] ?? "";
}

attachHands();
const begun = begin().catch((error) => { $("loading").textContent = error.message; $("loading").dataset.kept = "yes"; document.body.dataset.ready = "failed"; });

// For tests and benchmarks.
globalThis.hilsplat = {
  begun,
  get camera() { return page.camera; }, get painter() { return page.painter; }, painted, redraw, quickPick: (x, y) => quickPick(paneAt(x), y),
  pixels: () => ({ width: host.clientWidth, height: host.clientHeight, data: Array.from(page.painter.pixels(page.camera, painted(), host.clientWidth, host.clientHeight)) }),
};
