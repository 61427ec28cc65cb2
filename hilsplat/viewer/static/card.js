// The card of the chosen node: picture, name, parents, children and actions.

import * as api from "./api.js";
import { $, counted, inOrder, LEVELS, make, nameOf } from "./elements.js";
import { picture } from "./pictures.js";

export function parents(outline, node) {
  const above = [];
  for (let row = outline.nodes[node].parent; row >= 0; row = outline.nodes[row].parent) above.unshift(row);
  return above;
}

export const children = (outline, node) => outline.nodes.map((_, row) => row).filter((row) => outline.nodes[row].parent === node).sort(inOrder(outline));

export function showCard(outline, node, unit, { choose, fly, like, name, hover }) {
  const card = $("card");
  card.hidden = node < 0;
  if (node < 0) { card.replaceChildren(); return; }
  const own = outline.nodes[node], above = parents(outline, node), below = children(outline, node);
  const go = (row) => make("button", { type: "button", onclick: () => choose(row) }, nameOf(outline, row));
  const input = make("input", { class: "name", value: own.name, placeholder: nameOf(outline, node), maxlength: 80, "aria-label": "Name", title: "Name this node: queries match its name", disabled: api.offline,
    onkeydown: (event) => { if (event.key === "Enter") event.target.blur(); if (event.key === "Escape") { event.target.value = own.name; event.target.blur(); event.stopPropagation(); } },
    onchange: (event) => name(node, event.target.value.trim()) });
  const fact = (term, text) => make("div", {}, make("dt", {}, term), make("dd", {}, text));
  card.replaceChildren(
    make("div", { class: "top" },
      picture(api.cropUrl(outline.variant, node), { alt: `${nameOf(outline, node)} in a photograph`, width: 96, height: 96 }),
      make("div", {},
        above.length ? make("nav", { "aria-label": "Part of" }, ...above.flatMap((row) => [go(row), " › "])) : null,
        input,
        make("dl", {}, fact(LEVELS[own.level], `· node ${node}`), fact("seen in", counted(own.views, "photograph")),
          fact("Gaussians", own.gaussians.toLocaleString("en")), fact("size", `${own.size.map((v) => v.toPrecision(2)).join(" × ")}${unit}`)))),
    below.length ? make("div", { class: "kids", role: "group", "aria-label": "Made of" }, ...below.map((row) => make("button", { type: "button", title: nameOf(outline, row), onclick: () => choose(row), onpointerenter: () => hover(row), onpointerleave: () => hover(-1) },
      picture(api.cropUrl(outline.variant, row), { width: 56, height: 56 }), make("span", {}, nameOf(outline, row))))) : "",
    make("div", { class: "actions" },
      api.offline ? null : make("button", { type: "button", onclick: () => like(node) }, "More like this"),
      make("button", { type: "button", onclick: () => fly() }, "Fly there"),
      make("button", { type: "button", onclick: () => choose(-1) }, "Close")));
}
