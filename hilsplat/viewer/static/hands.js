// Input handlers: mouse and touch on the view, keys, and all controls of the page.

import * as api from "./api.js";
import { ask, askAs, askPicture, clear, clearAnswer, fillField, framed, keepAnswer, like } from "./asking.js";
import { children } from "./card.js";
import { choose, pointed, tapped } from "./choosing.js";
import { attach } from "./controls.js";
import { attachEditing, draw, edit, edited, leaveTool, placeBrush, pressed, redo, resizeBrush, tool, undo } from "./editing.js";
import { currentStyles, link, painted, redraw, rememberedAs, restyle } from "./drawing.js";
import { $, attachMenu, counted, make, nameOf } from "./elements.js";
import { flyTo, nearestView, setMoving, stand, step, touched } from "./flights.js";
import { groups, scoreOf } from "./kept.js";
import { attachKeys } from "./keyboard.js";
import { addToPath, attachPath, flown } from "./path.js";
import { save } from "./saves.js";
import { answererOf, failed, host, main, openLink, options, page, panes, tell, variantOf } from "./state.js";
import { choosePanes } from "./variants.js";

function showFrustums() {
  $("frustums").setAttribute("aria-pressed", String(!page.frustums));
  page.frustums = !page.frustums;
  redraw();
}

// Fly to the photograph whose camera is at a position of the view; false if there is none.
function tappedFrustum(x, y) {
  const box = host.getBoundingClientRect(), number = document.elementsFromPoint(x + box.left, y + box.top).find((element) => element.dataset.view)?.dataset.view;
  if (number === undefined) return false;
  stand(Number(number));
  return true;
}

// List the scenes of the results folder, of which each opens in this page, on the same server.
function addressOf(name) {
  const search = new URLSearchParams({ scene: name });
  if (options.get("painter")) search.set("painter", options.get("painter"));
  return `${location.pathname}?${search}`;
}

async function listScenes() {
  if (!$("scenes").open) return;
  try {
    const scenes = await api.scenes();
    $("scene-list").replaceChildren(...scenes.map(({ name, state, date, can_open, current }) => make("li", {},
      make("a", { href: can_open ? addressOf(name) : null, "aria-current": current ? "page" : null, "aria-disabled": can_open ? null : "true" },
        name, make("small", {}, [state, date].filter(Boolean).join(" · "))))));
  } catch (error) { failed(error); }
}

const MODES = ["tint", "ghost", "isolate", "plain"];

export function attachHands() {
  const rested = () => setMoving(false);
  const drawing = (event) => event.altKey ? { draw: framed } : tool() !== "move" && event.button === 0 ? { draw, taps: tool() === "brush" } : null;
  const touch = attach(host, { camera: () => page.camera, changed: touched, rested, tapped: (x, y) => { if (!tappedFrustum(x, y)) tapped(x, y); }, tool: drawing, pointed: (x, y) => { placeBrush(x, y); pointed(...(tool() === "move" ? [x, y] : [-1, -1])); } });
  const nudge = (work) => { work(); touch(); };
  const setLevel = (value) => { document.querySelector(`[name=level][value=${value}]`).checked = true; levelChanged(); };
  const levelChanged = () => { if (page.asked?.text && !api.offline) ask(true); else restyle(); };

  attachKeys({
    ask: () => { $("text").focus(); $("text").select(); },
    clear: () => { if (!leaveTool()) clear(); }, step: (by) => { if (!resizeBrush(by)) step(by); }, edit: () => { if (!api.offline) edit(); }, edited: pressed,
    undo, redo, home: () => stand(page.camera.first), help: () => $("help").showModal(),
    zoom: (factor) => nudge(() => page.camera.zoom(factor)), orbit: (x, y) => nudge(() => page.camera.orbit(0.1 * x, 0.1 * y)),
    move: (x, y, z) => nudge(() => page.camera.move(0.06 * x, 0.06 * y, 0.06 * z)),
    photo: () => $("blend").click(), fly: () => flyTo(page.chosen), like: () => like(page.chosen), level: setLevel, keep: keepAnswer, path: addToPath, frustums: showFrustums,
    name: () => $("card").querySelector(".name")?.focus(),
    mode: () => { $("mode").value = MODES[(MODES.indexOf($("mode").value) + 1) % MODES.length]; restyle(); },
    parent: () => { if (page.chosen >= 0 && main().nodes[page.chosen].parent >= 0) choose(main().nodes[page.chosen].parent); },
    child: () => { if (page.chosen >= 0 && children(main(), page.chosen).length) choose(children(main(), page.chosen)[0]); },
  });

  $("ask").addEventListener("submit", (event) => { event.preventDefault(); ask(); });
  $("text").addEventListener("search", () => { if (!$("text").value && page.asked?.text) clearAnswer(); });
  for (const radio of document.querySelectorAll("[name=level]")) radio.addEventListener("change", levelChanged);
  for (const id of ["left", "right"]) $(id).addEventListener("change", choosePanes);
  $("keep").addEventListener("click", keepAnswer);
  attachEditing();
  attachPath();
  $("scenes").hidden = api.offline || options.has("embedded");
  $("scenes").addEventListener("toggle", listScenes);
  $("mode").addEventListener("change", restyle);
  const thresholdChanged = () => {
    $("threshold-at").disabled = !$("threshold-on").checked;
    $("threshold-told").textContent = Number($("threshold-at").value).toFixed(2);
    restyle();
  };
  $("threshold-on").addEventListener("change", () => { thresholdChanged(); levelChanged(); });
  $("threshold-at").addEventListener("input", thresholdChanged);
  $("threshold-at").addEventListener("change", levelChanged);
  $("colour").addEventListener("change", () => {
    if (["relevancy", "field"].includes($("colour").value) && !page.asked) tell("Run a query first: these colours show how well nodes or Gaussians match it.");
    fillField();
  });
  $("blend").addEventListener("click", () => { if (page.camera.view < 0) stand(nearestView()); page.photos.cycle(); redraw(); });
  $("frustums").addEventListener("click", showFrustums);
  $("look").addEventListener("click", () => { flyTo(panes[0].answer.hits[0].node); $("view").focus(); });
  $("reload").addEventListener("click", () => location.reload());
  $("help-button").addEventListener("click", () => $("help").showModal());
  $("picture-button").addEventListener("click", () => $("picture").click());
  $("picture").addEventListener("change", () => { if ($("picture").files[0]) askPicture($("picture").files[0]); $("picture").value = ""; });
  document.addEventListener("paste", (event) => { const file = [...event.clipboardData.files].find((each) => each.type.startsWith("image/")); if (file) askPicture(file); });
  document.addEventListener("dragover", (event) => event.preventDefault());
  document.addEventListener("drop", (event) => { event.preventDefault(); const file = event.dataTransfer.files[0]; if (file?.type.startsWith("image/")) askPicture(file); });
  new ResizeObserver(redraw).observe(host);
  window.addEventListener("popstate", (event) => {   // Back and Forward restore the query of that entry
    if (!event.state) { location.reload(); return; }   // a link was opened in this tab
    const kept = new URLSearchParams(location.hash.slice(1)), text = kept.get("q") ?? "";
    clearAnswer();
    rememberedAs(text);
    openLink(kept);
    askAs(kept);
  });

  const selected = () => page.chosen >= 0 ? [{ name: nameOf(main(), page.chosen), nodes: [page.chosen], ...scoreOf(page.chosen) }] : groups();
  attachMenu($("save"));
  $("save").addEventListener("toggle", () => {
    const chosen = selected(), count = chosen.reduce((sum, group) => sum + group.nodes.length, 0);
    $("save-what").textContent = page.chosen >= 0 ? `For ${chosen[0].name}` : chosen.length ? `For ${counted(count, "answer")} to ${chosen.map((group) => group.name).join(", ")}` : "Run a query or select a node to save its Gaussians, boxes and masks.";
    for (const button of $("save").querySelectorAll("[data-nodes]")) button.disabled = !count || ("long" in button.dataset && !$("saving").hidden);
  });
  $("save").addEventListener("click", async (event) => {
    const kind = event.target.closest("[data-save]")?.dataset.save;
    if (!kind) return;
    $("save").open = false;
    try {
      if (kind === "link") { await navigator.clipboard.writeText(location.href); tell("Link copied. It opens this view while the viewer is running."); return; }
      await edited();
      const side = Number($("still-side").value), scale = side ? side / Math.max(host.clientWidth, host.clientHeight) : devicePixelRatio, size = [host.clientWidth, host.clientHeight].map((px) => Math.round(px * scale));
      await save(kind, { variant: variantOf(panes[0]), answerer: answererOf(panes[0]), groups: selected(), removed: page.removed, style: currentStyles()[0], capture: () => page.painter.capture(page.camera, painted(), ...size), flown: flown(),
        queries: [...page.kept, { asked: page.asked?.query }].map((query) => query.asked).filter(Boolean), link: link().toString(), name: page.scene.name.split("/").at(-1), told: tell });
      redraw();
    } catch (error) { failed(error); }
  });
}
