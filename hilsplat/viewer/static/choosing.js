// The chosen node, the node under the pointer, and names given by the user.

import * as api from "./api.js";
import { markChosen } from "./answers.js";
import { showCard } from "./card.js";
import { painted, restyle } from "./drawing.js";
import { LEVELS } from "./elements.js";
import { flyTo } from "./flights.js";
import { inOrder, latest } from "./latest.js";
import { failed, host, level, main, outlines, page, panes, tell, variantOf } from "./state.js";
import { wireStyle } from "./styles.js";

// Actions of lists and cards of nodes; asking.js adds `like`.
export const acts = { choose, hover: setHover, fly: () => flyTo(page.chosen), name: rename };

let others = 0;   // choices made by other means than a click on the view
export function choose(node) { others++; chooseNow(node); }

function chooseNow(node) {
  page.chosen = node;
  page.hover = -1;
  markChosen(node);
  if (main()) showCard(main(), node, page.scene.unit === "metre" ? " m" : "", acts);
  page.outline.select(node);   // after showing the card, because the card makes the outline smaller
  restyle();
}

export function setHover(node) {
  if (node === page.hover) return;
  page.hover = node;
  restyle();
}

export function paneAt(x) {
  const each = host.clientWidth / panes.length, k = Math.max(0, Math.min(panes.length - 1, Math.floor(x / each)));   // a drag may end outside
  return { k, x: x - k * each, width: each, height: host.clientHeight };
}

const exactPick = async (at, y) => {
  const { style } = painted()[at.k];
  const { nodes } = await api.pick({ variant: variantOf(panes[at.k]), camera: page.camera.wire(at.width, at.height), x: at.x, y, removed: page.removed, ...(style.mode === "isolate" ? { style: wireStyle(style) } : {}) });
  return nodes.map(([node]) => node);
};
export const quickPick = (at, y) => page.painter.nodesAt(variantOf(panes[at.k]), page.painter.gaussianAt(page.camera, painted()[at.k], at.x, y, at.width, at.height));

// A click chooses the whole; clicking the chosen node chooses one level down, or the whole again after the finest level.
function deeper(nodes) {
  const fixed = LEVELS.indexOf(level());
  if (fixed >= 0) return [...nodes.slice(0, fixed + 1)].reverse().find((node) => node >= 0) ?? -1;
  const there = nodes.filter((node) => node >= 0), at = there.indexOf(page.chosen);
  return there[(at + 1) % Math.max(there.length, 1)] ?? -1;
}

const next = inOrder(failed);

export function tapped(x, y) {
  host.focus({ preventScroll: true });
  const at = paneAt(x);
  if (!main()) { tell("Nothing to select yet: the semantic tree is not loaded."); return; }
  if (variantOf(panes[at.k]) !== variantOf(panes[0])) { tell("This side shows a different tree. Select nodes on the left."); return; }
  const before = others;
  next(async () => {
    const nodes = api.offline ? quickPick(at, y) : await exactPick(at, y);
    if (others === before) chooseNow(deeper(nodes));   // a later choice stays
  });
}

const hoverAt = latest(async (x, y) => {
  if (x < 0 || page.moving || !main()) { setHover(-1); return; }
  const at = paneAt(x);
  if (variantOf(panes[at.k]) !== variantOf(panes[0])) return;
  try {
    const nodes = page.painter.kind === "gl" ? quickPick(at, y) : await exactPick(at, y);
    const fixed = LEVELS.indexOf(level()), there = nodes.filter((node) => node >= 0);
    setHover(fixed >= 0 ? deeper(nodes) : there.includes(page.chosen) ? deeper(nodes) : there[0] ?? -1);
  } catch { setHover(-1); }
});
let pointing = 0;
export const pointed = (x, y) => { clearTimeout(pointing); pointing = setTimeout(() => hoverAt(x, y), page.painter?.kind === "gl" && !page.slow ? 16 : 60); };

// Show the names that a tree's nodes have on the server.
export async function readNames(own) {
  const { nodes, version } = await api.variant(own.variant);
  own.version = version;
  nodes.forEach(({ name }, row) => { if (own.nodes[row].name !== name) { own.nodes[row].name = name; if (own === main()) page.outline.renamed(row); } });
  acts.list();
}

const nextName = inOrder(failed);   // each name is sent with the version that the one before it made
function rename(node, name) {
  const variant = variantOf(panes[0]);
  nextName(() => renameNow(variant, node, name));
}

async function renameNow(variant, node, name) {
  const own = outlines.get(variant), names = {};
  own.nodes.forEach((each, row) => { if (each.name) names[row] = each.name; });
  names[node] = name;
  try {
    const kept = await api.names({ variant: own.variant, names }, own.version);
    for (const each of outlines.values()) if (each.tree === own.tree) {
      each.version = kept.version;
      each.nodes.forEach((entry, row) => { entry.name = kept.names[row] ?? ""; });
    }
    page.outline.renamed(node);
    tell(name ? `Named “${name}”. Queries match this name, here and with hilsplat query.` : "The name was removed.");
    if (page.chosen === node) chooseNow(node);   // after showing the message, because it makes the outline smaller
    acts.list();
  } catch (error) {
    if (error.status === 412) { await readNames(own); choose(page.chosen); tell("The names were changed elsewhere and have been reloaded. Name the node again.", true); } else failed(error);
  }
}
