// The semantic tree as a tree widget with names and crops; keys follow the ARIA practices. A large tree is folded, and
// the items below a node are made when it is unfolded.

import * as api from "./api.js";
import { $, counted, inOrder, LEVELS, make, nameOf } from "./elements.js";
import { picture } from "./pictures.js";

const FOLD_FROM = 200;   // number of nodes above which a tree is folded below its wholes

export class Outline {
  constructor({ choose, fly, hover }) {
    this.root = $("outline");
    this.items = new Map();
    this.handlers = { choose, fly, hover };
    this.root.addEventListener("keydown", (event) => this.key(event));
    this.root.addEventListener("click", (event) => this.click(event));
    this.root.addEventListener("pointerover", (event) => hover(this.nodeOf(event.target)));
    this.root.addEventListener("pointerleave", () => hover(-1));
  }

  nodeOf(target) {
    const item = target.closest("[role=treeitem]");
    return item ? Number(item.dataset.node) : -1;
  }

  show(outline) {
    this.outline = outline;
    this.items.clear();
    this.answers = new Set();
    this.children = new Map();
    outline.nodes.forEach(({ parent }, row) => this.children.has(parent) ? this.children.get(parent).push(row) : this.children.set(parent, [row]));
    for (const rows of this.children.values()) rows.sort(inOrder(outline));
    this.folded = outline.nodes.length >= FOLD_FROM;
    this.root.replaceChildren(...(this.children.get(-1) ?? []).map((row) => this.item(row)));
    const first = this.root.querySelector("[role=treeitem]");
    if (first) first.tabIndex = 0;
    $("outline-section").hidden = !outline.nodes.length;
    $("outline-title").textContent = `Outline: ${LEVELS.map((level, k) => counted(outline.nodes.filter((n) => n.level === k).length, level)).join(", ")}`;
  }

  item(row) {
    const { outline } = this, node = outline.nodes[row], kids = this.children.has(row);
    const element = make("li", { role: "treeitem", tabindex: "-1", "data-node": row, "aria-selected": "false", "aria-level": node.level + 1,
      "aria-expanded": kids ? String(!this.folded) : null, "aria-label": `${nameOf(outline, row)}, ${LEVELS[node.level]}` },
    make("div", { class: "row" },
      make("span", { class: "fold", "aria-hidden": "true" }, kids ? "▶" : ""),
      picture(api.cropUrl(outline.variant, row), { width: 48, height: 48 }),
      make("span", { class: "label" }, nameOf(outline, row)),
      make("small", {}, counted(node.views, "view"))));
    element.classList.toggle("answered", this.answers.has(row));
    this.items.set(row, element);
    if (kids && !this.folded) this.fill(element);
    return element;
  }

  // Make the items below a node, unless they exist.
  fill(item) {
    if (!item.querySelector("[role=group]")) item.append(make("ul", { role: "group" }, ...this.children.get(Number(item.dataset.node)).map((row) => this.item(row))));
  }

  // Return the item of a node, or undefined; the items above it are made first.
  itemOf(row) {
    const parent = this.outline.nodes[row]?.parent ?? -1;
    if (!this.items.has(row) && parent >= 0) this.fill(this.itemOf(parent));
    return this.items.get(row);
  }

  renamed(row) {
    const item = this.itemOf(row);
    item.querySelector(".label").textContent = nameOf(this.outline, row);
    item.setAttribute("aria-label", `${nameOf(this.outline, row)}, ${LEVELS[this.outline.nodes[row].level]}`);
  }

  answered(nodes) {
    for (const item of this.root.querySelectorAll(".answered")) item.classList.remove("answered");
    this.answers = new Set(nodes);
    for (const node of nodes) this.items.get(node)?.classList.add("answered");
  }

  select(node) {
    for (const item of this.root.querySelectorAll("[aria-selected=true]")) item.setAttribute("aria-selected", "false");
    const item = this.itemOf(node);
    if (!item) return;
    item.setAttribute("aria-selected", "true");
    for (let above = item.parentElement.closest("[role=treeitem]"); above; above = above.parentElement.closest("[role=treeitem]")) above.setAttribute("aria-expanded", "true");
    this.rove(item);
    item.querySelector(".row").scrollIntoView({ block: "nearest" });
  }

  rove(item, focus = false) {
    for (const other of this.root.querySelectorAll("[tabindex='0']")) other.tabIndex = -1;
    item.tabIndex = 0;
    if (focus) { item.focus({ preventScroll: true }); item.querySelector(".row").scrollIntoView({ block: "nearest" }); }
  }

  click(event) {
    const item = event.target.closest("[role=treeitem]");
    if (!item) return;
    if (event.target.closest(".fold")?.textContent) return this.fold(item, item.getAttribute("aria-expanded") !== "true");
    this.handlers.choose(Number(item.dataset.node));
  }

  fold(item, open) {
    if (!item.hasAttribute("aria-expanded")) return;
    if (open) this.fill(item);
    item.setAttribute("aria-expanded", String(open));
  }

  get visible() {
    return [...this.root.querySelectorAll("[role=treeitem]")].filter((item) => !item.parentElement.closest("[aria-expanded=false]"));
  }

  key(event) {
    const item = event.target.closest("[role=treeitem]");
    if (!item || event.ctrlKey || event.metaKey || event.altKey) return;
    const shown = this.visible, at = shown.indexOf(item), open = item.getAttribute("aria-expanded");
    const go = (to) => to && this.rove(to, true);
    const actions = {
      ArrowDown: () => go(shown[at + 1]), ArrowUp: () => go(shown[at - 1]), Home: () => go(shown[0]), End: () => go(shown.at(-1)),
      ArrowRight: () => open === "false" ? this.fold(item, true) : go(item.querySelector("[role=treeitem]")),
      ArrowLeft: () => open === "true" ? this.fold(item, false) : go(item.parentElement.closest("[role=treeitem]")),
      Enter: () => { this.handlers.choose(Number(item.dataset.node)); if (event.shiftKey) this.handlers.fly(); },
      " ": () => this.handlers.choose(Number(item.dataset.node)),
    };
    if (!actions[event.key]) return;
    actions[event.key]();
    event.preventDefault();
    event.stopPropagation();
  }
}
