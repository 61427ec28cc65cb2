// Variants of the scene, one or two side by side, including variants that appear during a run.

import * as api from "./api.js";
import { ask, askAs, clearAnswer, listAnswers } from "./asking.js";
import { choose, readNames } from "./choosing.js";
import { redraw, restyle } from "./drawing.js";
import { $, counted, make } from "./elements.js";
import { askKeptAgain, keepFromStart } from "./kept.js";
import { follow } from "./stopped.js";
import { failed, loadVariant, main, outlines, page, panes, sceneChanged, start, tell, variantOf } from "./state.js";

export function fillVariants() {
  const choices = page.scene.variants.flatMap((name) => [[`${name}|tree`, `${name}, tree`], [`${name}|field`, `${name}, field`]]);
  const fill = (select, kept, more) => {
    select.replaceChildren(...more, ...choices.map(([value, text]) => make("option", { value }, text)));
    select.value = kept;
  };
  fill($("left"), panes[0].by, []);
  fill($("right"), panes[1]?.by ?? "", [make("option", { value: "" }, "nothing")]);
  $("left").disabled = $("right").disabled = api.offline || !choices.length;
}

export async function useVariants() {
  const known = (by) => page.scene.variants.includes(by?.split("|")[0]) ? by : null;
  panes[0].by = known(start.get("by")) ?? `${page.scene.variants[0]}|tree`;
  const beside = known(start.get("beside"));
  if (beside && !api.offline) panes[1] = { by: beside, answer: null, field: null };
  for (const pane of panes) await loadVariant(variantOf(pane));
  fillVariants();
  showOutline();
  const wasWaiting = page.waiting;
  page.waiting = false;
  await keepFromStart();
  if (wasWaiting) await ask(); else await askAs(start);
  const [node, tree] = (start.get("node") ?? "").split(".");   // the row is valid only in the same tree
  if (tree === main().tree && main().nodes[node]) choose(Number(node));
}

function showOutline() {
  page.outline.show(main());
  const names = [...new Set(main().nodes.map((node) => node.name || node.called).filter((name) => name && name !== "?"))];
  if (names.length && !api.offline) $("text").placeholder = names.slice(0, 2).join(", or ");
  listAnswers();
  $("about").textContent = `${page.scene.name}: ${counted(page.scene.gaussians, "Gaussian")}. Masks: ${main().masks}. Text and image vectors: ${main().clip}.`;
}

export async function choosePanes() {
  try {
    const left = $("left").value, right = $("right").value, changed = left.split("|")[0] !== variantOf(panes[0]);
    panes[0] = left === panes[0].by ? panes[0] : { by: left, answer: null, field: null };
    if (!right) panes.length = 1;
    else if (panes[1]?.by !== right) panes[1] = { by: right, answer: null, field: null };
    for (const pane of panes) await loadVariant(variantOf(pane));
    if (changed) { choose(-1); showOutline(); }
    if (page.asked?.text) await ask(true);
    else if (page.asked && !panes[0].answer) clearAnswer();   // similar nodes of the previous tree
    else listAnswers();
    await askKeptAgain();
    restyle();
  } catch (error) { failed(error); }
}

// Check regularly whether files of the scene changed and whether there are new variants.
export const watch = () => follow(api.changes, async (now) => {
  if (!$("changed").hidden) return;
  if (page.painter.unfinished) redraw();   // the server could not render the last picture
  if (now.of !== page.scene.of || now.changed.length) sceneChanged(now.changed);
  else if (now.variants.join() !== page.scene.variants.join()) await moreAnswer(now.variants);
  else await renamedElsewhere(now.names);
}, { failed });

// Show names that were given in another tab.
async function renamedElsewhere(versions) {
  for (const [variant, own] of outlines) {
    if (!(variant in versions) || versions[variant] === own.version) continue;
    await readNames(own);
  }
}

async function moreAnswer(variants) {
  const first = !page.scene.variants.length;
  page.scene.variants = variants;
  if (!first) { fillVariants(); return; }
  tell("You can now query the scene.");
  await useVariants();
}
