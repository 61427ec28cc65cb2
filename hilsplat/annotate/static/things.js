// The objects of a photograph as a tree widget, the form of the chosen object, and the strip of photographs.

import { thumbUrl } from "./api.js";
import { $, attachArrows, counted, LEVELS, make, shape } from "./elements.js";
import { colour } from "./sheet.js";

export const LEVEL = (label) => LEVELS[label.level - 1];
export const under = (labels, id) => labels.filter((label) => label.parent === id).flatMap((label) => [label.id, ...under(labels, label.id)]);

export function showThings(labels, chosen, choose) {
  const here = new Set(labels.map((label) => label.id));
  const item = (label) => {
    const kids = labels.filter((each) => each.parent === label.id), proposed = label.origin === "proposed";
    const swatch = shape("svg", { viewBox: "0 0 12 12", "aria-hidden": "true" });
    swatch.append(shape("rect", { width: 12, height: 12, rx: 3, fill: colour(label.id) }));
    const made = make("li", { role: "treeitem", tabindex: "-1", "data-id": label.id, "aria-selected": String(label.id === chosen), "aria-level": label.level,
      "aria-expanded": kids.length ? "true" : null, "aria-label": `${label.text}, ${LEVEL(label)}${proposed ? ", proposed" : ""}` },
    make("div", { class: "row", onclick: () => choose(label.id) }, swatch, make("span", { class: "label" }, label.text),
      make("small", { class: proposed ? "proposed" : "" }, proposed ? `${LEVEL(label)}, proposed` : LEVEL(label))));
    if (kids.length) made.append(make("ul", { role: "group" }, ...kids.map(item)));
    return made;
  };
  const focused = document.activeElement.closest?.("#things [role=treeitem]")?.dataset.id;
  $("things").replaceChildren(...labels.filter((label) => !here.has(label.parent)).map(item));
  const items = [...$("things").querySelectorAll("[role=treeitem]")], own = (id) => items.find((each) => each.dataset.id === String(id));
  (own(chosen) ?? items[0])?.setAttribute("tabindex", "0");
  if (focused) (own(focused) ?? items[0])?.focus();
  const waiting = labels.filter((label) => label.origin === "proposed").length;
  $("things-title").textContent = `In this photograph: ${counted(labels.length, "thing")}${waiting ? `, ${waiting} proposed` : ""}`;
}

export function attachThings(choose) {
  $("things").addEventListener("keydown", (event) => {
    const items = [...$("things").querySelectorAll("[role=treeitem]")], at = items.indexOf(event.target.closest("[role=treeitem]"));
    const to = { ArrowDown: at + 1, ArrowUp: at - 1, Home: 0, End: items.length - 1 }[event.key];
    if (to !== undefined) items[to]?.focus();
    else if (event.key === "Enter" || event.key === " ") choose(Number(items[at].dataset.id));
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
}

export const level = () => Number(document.querySelector("[name=level]:checked").value);
export const setLevel = (value) => { document.querySelector(`[name=level][value="${value}"]`).checked = true; };

let filled = "";   // the object and text that the form shows

// Show the chosen object in the form, or the settings of the next object; a text that is being typed stays.
export function fillForm(labels, label, next) {
  const own = label ?? next, now = `${label?.id} ${own.text}`;
  $("title").textContent = label ? `${label.text}, ${LEVEL(label)}${label.origin === "proposed" ? ": proposed" : ""}` : "New thing";
  if (document.activeElement !== $("text") || now !== filled) $("text").value = own.text;
  filled = now;
  setLevel(own.level);
  const above = labels.filter((each) => each.level === own.level - 1);
  $("parent").replaceChildren(make("option", { value: "" }, "nothing"), ...above.map((each) => make("option", { value: each.id }, each.text)));
  $("parent").value = above.some((each) => each.id === own.parent) ? String(own.parent) : "";
  $("parent").disabled = own.level === 1;
  $("child").disabled = !label || label.level === 3;
  $("accept").disabled = label?.origin !== "proposed";
  $("delete").disabled = !label;
}

export function showTexts(things) {
  $("texts").replaceChildren(...[...new Set([...things.values()].map((label) => label.text))].sort().map((value) => make("option", { value })));
}

export function makeStrip(views, stand) {
  $("views").replaceChildren(...views.map((view, number) => make("button", { type: "button", role: "option", class: view.split, title: view.name, onclick: () => stand(number) },
    make("img", { src: thumbUrl(number), alt: "", loading: "lazy" }))));
  attachArrows($("views"));
}

export function markStrip(views, store, number) {
  [...$("views").children].forEach((button, k) => {
    const count = store.labels(k).length, waiting = store.labels(k).some((label) => label.origin === "proposed");
    button.setAttribute("aria-selected", String(k === number));
    button.tabIndex = k === number ? 0 : -1;
    button.setAttribute("aria-label", `${views[k].name}${views[k].split === "test" ? ", held out" : ""}, ${counted(count, "thing")}${waiting ? ", some proposed" : ""}`);
    button.dataset.count = count;
    button.classList.toggle("annotated", count > 0);
    button.classList.toggle("waiting", waiting);
  });
}
