// Create elements from tags, attributes and children; text is never parsed as markup.

export const $ = (id) => document.getElementById(id);

export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

// Create an SVG element.
export function shape(tag, attributes, text = "") {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) if (value !== null) made.setAttribute(name, value);
  made.textContent = text;
  return made;
}

// Close a menu on Esc, or when something else is clicked.
export function attachMenu(menu) {
  document.addEventListener("pointerdown", (event) => { if (!menu.contains(event.target)) menu.open = false; });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !menu.open) return;
    menu.open = false;
    menu.querySelector("summary").focus();
    event.stopPropagation();
  }, true);
}

// Let the arrow keys choose the next and previous item of a list of buttons.
export function attachArrows(list) {
  list.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key], next = list.children[[...list.children].indexOf(document.activeElement) + step];
    if (!step) return;
    if (next) { next.focus(); next.click(); }
    event.preventDefault(); event.stopPropagation();
  });
}

export const counted = (count, noun) => `${count.toLocaleString("en")} ${noun}${count === 1 ? "" : "s"}`;
export const LEVELS = ["whole", "part", "subpart"];
// Return the user's name, else the vocabulary name, else "?".
export function nameOf(outline, node) {
  const { name, called, level } = outline.nodes[node], numbered = `${LEVELS[level]} ${node}`;
  return name || (called === "?" ? `? (${numbered})` : called || numbered);
}

// Sort things before surfaces, and large nodes before small nodes.
export const inOrder = (outline) => (a, b) => outline.nodes[a].surface - outline.nodes[b].surface || outline.nodes[b].gaussians - outline.nodes[a].gaussians;
