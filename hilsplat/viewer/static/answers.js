// The list of answers, and what is doubtful about them.

import * as api from "./api.js";
import { $, counted, make, nameOf } from "./elements.js";
import { picture } from "./pictures.js";
import { shownHits } from "./styles.js";

export function showAnswers(outline, answer, { choose, hover }) {
  const list = $("answers");
  $("answers-section").hidden = !answer?.hits.length;
  const caution = (answer ?? outline)?.caution ?? "";   // an answer by name or by likeness has none
  $("caution").hidden = !caution;
  $("caution").textContent = caution;
  list.replaceChildren(...(answer?.hits ?? []).map((hit, rank) => make("li", { "data-node": hit.node },
    make("button", { type: "button", onclick: () => choose(hit.node), onpointerenter: () => hover(hit.node), onpointerleave: () => hover(-1), onfocus: () => hover(hit.node), onblur: () => hover(-1) },
      picture(api.cropUrl(outline.variant, hit.node), { width: 48, height: 48 }),
      make("span", { class: "name" }, hit.name || nameOf(outline, hit.node), make("small", {}, `${rank + 1}. ${hit.level}`)),
      bar(hit.score)))));
}

function bar(score) {
  const filled = make("b");
  filled.style.width = `${Math.round(100 * Math.max(0, Math.min(1, score)))}%`;
  return make("span", { class: "score" }, score.toFixed(2), make("i", { "aria-hidden": "true" }, filled));
}

export function summary(answer) {
  if (!answer.hits.length) return `Nothing answers to “${answer.text}”.`;
  const best = answer.hits[0], alike = answer.route === "like";
  const lines = [alike
    ? `${counted(answer.hits.length, "node")}, most alike first; the best ${best.score.toFixed(2)}. The first ${shownHits(answer).length} are painted.`
    : `${counted(answer.total, "answer")}, best ${best.score.toFixed(2)}, ${answer.level}`];
  if (answer.route === "fallback") lines.push("No answer is part of anything that answers to the first text.");
  const doubts = answer.doubts.map((doubt) => `${doubt}.`);
  if (!alike && best.score < 0.5 && !doubts.length) doubts.push("Perhaps nothing of the kind: the best is below 0.5.");
  return [...lines, ...doubts].map((line) => line[0].toUpperCase() + line.slice(1)).join("\n");
}

export function markChosen(node) {
  for (const item of $("answers").children) item.setAttribute("aria-current", String(Number(item.dataset.node) === node));
}
