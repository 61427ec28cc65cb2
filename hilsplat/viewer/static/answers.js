// The list of answers and their doubts.

import * as api from "./api.js";
import { $, counted, make, nameOf } from "./elements.js";
import { picture } from "./pictures.js";
import { isDoubtful, LISTED, shownHits } from "./styles.js";

// beside: {outline, answer, by} of the right pane, or undefined.
export function showAnswers(outline, answer, acts, beside) {
  const theirs = beside?.answer?.hits ?? [], own = answer?.hits ?? [], sameTree = beside?.outline?.tree === outline?.tree;
  $("answers-section").hidden = !own.length && !theirs.length;
  const caution = (answer ?? outline)?.caution ?? "";   // answers by name or by similarity have no caution
  $("caution").hidden = !caution;
  $("caution").textContent = caution;
  const only = (hit, others) => sameTree && !others.some((other) => other.node === hit.node);
  $("answers").replaceChildren(...own.slice(0, LISTED).map((hit, rank) => item(outline, hit, rank, acts, beside && only(hit, theirs) ? ", only on the left" : "")));
  $("beside").hidden = !beside?.answer;
  if (!beside?.answer) { $("answers-beside").replaceChildren(); return; }
  const both = theirs.filter((hit) => !only(hit, own)).length;
  $("beside-title").textContent = `On the right, by ${beside.by}${sameTree ? `: ${both} of ${theirs.length} are on the left too` : ", from a different tree"}`;
  $("answers-beside").replaceChildren(...theirs.slice(0, LISTED).map((hit, rank) => item(beside.outline, hit, rank, sameTree ? acts : null, only(hit, own) ? ", only on the right" : "")));
}

// Nodes cannot be chosen if their tree differs from that of the left pane.
function item(outline, hit, rank, acts, note) {
  const look = acts && { onclick: () => acts.choose(hit.node), onpointerenter: () => acts.hover(hit.node), onpointerleave: () => acts.hover(-1), onfocus: () => acts.hover(hit.node), onblur: () => acts.hover(-1) };
  return make("li", { "data-node": hit.node }, make("button", { type: "button", disabled: !acts, ...look },
    picture(api.cropUrl(outline.variant, hit.node), { width: 48, height: 48 }),
    make("span", { class: "name" }, nameOf(outline, hit.node), make("small", {}, `${rank + 1}. ${hit.level}${note}`)),
    bar(hit.score)));
}

function bar(score) {
  const filled = make("b");
  filled.style.width = `${Math.round(100 * Math.max(0, Math.min(1, score)))}%`;
  return make("span", { class: "score" }, score.toFixed(2), make("i", { "aria-hidden": "true" }, filled));
}

// Doubts about an answer, as in saved files.
export function doubtsOf(answer) {
  if (answer.doubts.length || !isDoubtful(answer)) return answer.doubts;
  return ["the object may be absent: the best score is below 0.5"];
}

export function summary(answer) {
  if (!answer.hits.length) return `No node matches “${answer.text}”.`;
  const best = answer.hits[0], alike = answer.route === "like";
  const lines = [alike
    ? `${counted(answer.hits.length, "node")}, most similar first, best ${best.score.toFixed(2)}. The first ${shownHits(answer).length} are highlighted.`
    : `${counted(answer.hits.length, "answer")}${answer.hits.length > LISTED ? `, of which the first ${LISTED} are listed` : ""}, best ${best.score.toFixed(2)}, ${answer.level}`];
  if (answer.route === "fallback") lines.push("No answer is part of a match for the first text: the whole scene was searched.");
  return [...doubtsOf(answer).map((doubt) => `${doubt}.`), ...lines].map((line) => line[0].toUpperCase() + line.slice(1)).join("\n");
}

export function markChosen(node) {
  for (const item of $("answers").children) item.setAttribute("aria-current", String(Number(item.dataset.node) === node));
}
