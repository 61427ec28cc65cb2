// Who answers: variants of the scene, one or two of them side by side, as they come to exist.

import { showAnswers } from "./answers.js";
import * as api from "./api.js";
import { ask } from "./asking.js";
import { acts, choose } from "./choosing.js";
import { redraw, restyle } from "./drawing.js";
import { $, counted, make } from "./elements.js";
import { failed, loadVariant, main, page, panes, start, tell, variantOf } from "./state.js";

export const POLL_MS = 5000;

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
  if (beside && !api.offline) panes[1] = { by: beside, answer: null, field: false };
  for (const pane of panes) await loadVariant(variantOf(pane));
  fillVariants();
  showOutline();
  if (start.get("q")) { $("text").value = start.get("q"); await ask(); }
  const node = Number(start.get("node") ?? -1);
  if (node >= 0 && node < main().nodes.length) choose(node);
}

function showOutline() {
  page.outline.show(main());
  showAnswers(main(), panes[0].answer, acts);
  $("about").textContent = `${page.scene.name}: ${counted(page.scene.gaussians, "Gaussian")}. Masks by ${main().masks}, words and pictures by ${main().clip}.`;
  restyle();
}

export async function choosePanes() {
  try {
    const left = $("left").value, right = $("right").value, changed = left.split("|")[0] !== variantOf(panes[0]);
    panes[0] = left === panes[0].by ? panes[0] : { by: left, answer: null, field: false };
    if (!right) panes.length = 1;
    else if (panes[1]?.by !== right) panes[1] = { by: right, answer: null, field: false };
    for (const pane of panes) await loadVariant(variantOf(pane));
    if (changed) { choose(-1); showOutline(); }
    if (page.asked?.text) await ask(true); else restyle();
    redraw();
  } catch (error) { failed(error); }
}

export async function answersLater() {   // while the run goes
  try { page.scene.variants = (await api.scene()).variants; } catch { return; }
  if (!page.scene.variants.length) { setTimeout(answersLater, POLL_MS); return; }
  try { tell("Answers are ready."); await useVariants(); } catch (error) { failed(error); }
}
