// Kept queries: each has a colour, and can be hidden, edited or removed.

import { doubtsOf } from "./answers.js";
import * as api from "./api.js";
import { restyle } from "./drawing.js";
import { $, counted, make } from "./elements.js";
import { inOrder } from "./latest.js";
import { answererOf, failed, keptIn, level, main, page, panes, start, tell, threshold, variantOf } from "./state.js";
import { KEPT, shownHits } from "./styles.js";

// A query's settings without its answerer.
export const asking = (text) => ({ text, level: level(), ...(threshold() === null ? {} : { threshold: threshold() }),
  ...($("here").checked && page.camera.view >= 0 ? { view: page.camera.view } : {}) });

async function answered(query) {
  const answers = new Map();   // by answerer, because nodes of one tree mean nothing in another
  for (const pane of [...panes]) answers.set(pane.by, await api.query({ variant: variantOf(pane), answerer: answererOf(pane), ...query.asked }));
  query.answers = answers;
}

const freeColour = () => KEPT.findIndex((_, k) => page.kept.every((query) => query.colour !== k));

const next = inOrder(failed);   // of two at once, the second finds the first
export const keep = (asked, shown = true) => next(() => keepNext(asked, shown));

async function keepNext(asked, shown) {
  if (page.kept.length >= KEPT.length) { tell(`At most ${KEPT.length} queries can be kept: remove one first.`, true); return false; }
  const same = page.kept.findIndex((query) => JSON.stringify(query.asked) === JSON.stringify(asked)), query = same < 0 ? { asked, shown, colour: freeColour() } : page.kept[same];
  await answered(query);
  if (same < 0) page.kept.push(query);
  showKept();
  return true;
}

// Kept queries from the address or from an exported page.
export async function keepFromStart() {
  for (const [key, text] of start) {
    let asked = null;
    try { asked = ["keep", "hidden"].includes(key) && JSON.parse(text); } catch { /* a damaged link */ }
    if (asked?.text) await keep(asked, key === "keep");
  }
}

// Send all kept queries again after a change of answerer or tree.
export const askKeptAgain = () => next(async () => {
  if (!page.kept.length) return;
  showKept();
  for (const query of page.kept) await answered(query);
  showKept();
});

// Return the nodes of all shown queries with scores and doubts, for saved files.
export function groups() {
  const saved = ({ answer, text }) => ({ name: text, nodes: shownHits(answer).map((hit) => hit.node), scores: shownHits(answer).map((hit) => hit.score), doubts: doubtsOf(answer) });
  const found = keptIn(0).map(saved), answer = panes[0].answer;
  if (answer) found.push(saved({ answer, text: answer.text }));
  return found.filter((group) => group.nodes.length);
}

// Return the score and doubts of a node that is an answer.
export function scoreOf(node) {
  const group = groups().find(({ nodes }) => nodes.includes(node));
  return group ? { scores: [group.scores[group.nodes.indexOf(node)]], doubts: group.doubts } : {};
}

let reopen = () => {};
export const whenReopened = (work) => { reopen = work; };

export function showKept() {
  $("kept-section").hidden = !page.kept.length && !page.asked?.text;
  $("keep").hidden = !page.asked?.text || !panes[0].answer?.hits.length || api.offline;
  $("kept").replaceChildren(...page.kept.map((query) => {
    const { text, level: at, threshold: least } = query.asked, answer = query.answers.get(panes[0].by), doubts = answer ? doubtsOf(answer) : [];
    const swatch = make("button", { type: "button", class: "swatch", "aria-pressed": String(query.shown), "aria-label": `Show ${text}`, title: query.shown ? "Hide" : "Show",
      onclick: () => { query.shown = !query.shown; showKept(); } });
    swatch.style.setProperty("--kept", `rgb(${KEPT[query.colour].join(" ")})`);
    return make("li", {}, swatch,
      make("button", { type: "button", class: "words", title: ["Edit", ...doubts].join("\n"), disabled: api.offline, onclick: () => { drop(query); reopen(query.asked); } },
        text, make("small", {}, [...(doubts.length ? ["doubtful"] : []), ...(answer ? [at === "auto" ? answer.level : at, counted(answer.hits.length, "answer")] : ["…"]), ...(answer?.hits.length ? [`best ${answer.hits[0].score.toFixed(2)}`] : []), ...(least ? [`score at least ${least.toFixed(2)}`] : [])].join(", "))),
      api.offline ? null : make("button", { type: "button", class: "drop", "aria-label": `Remove ${text}`, title: "Remove", onclick: () => drop(query) }, "×"));
  }));
  $("overlaps").textContent = overlaps();
  restyle();
}

function drop(query) {
  page.kept = page.kept.filter((other) => other !== query);
  showKept();
}

// Report nodes found by several queries, and nodes inside another query's nodes.
function overlaps() {
  const shown = [...keptIn(0).map(({ answer }) => answer), ...(page.kept.length && panes[0].answer ? [panes[0].answer] : [])], times = new Map();
  if (!main() || shown.length < 2) return "";
  const sets = shown.map((answer) => new Set(shownHits(answer).map((hit) => hit.node)));
  for (const set of sets) for (const node of set) times.set(node, (times.get(node) ?? 0) + 1);
  const common = [...times.values()].filter((count) => count > 1).length;
  const inside = sets.reduce((sum, set, k) => sum + [...set].filter((node) => {
    for (let row = main().nodes[node].parent; row >= 0; row = main().nodes[row].parent) if (sets.some((other, j) => j !== k && other.has(row))) return true;
    return false;
  }).length, 0);
  return [common ? `White: ${counted(common, "node")} found by several queries.` : "", inside ? `${counted(inside, "answer")} inside an answer to another query.` : ""].filter(Boolean).join(" ");
}
