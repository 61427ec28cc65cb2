// Keyboard shortcuts, which are ignored while the user types and don't override the keys of the browser or of controls.

import { historyOf, isCommand, keyOf } from "./keys.js";

const STEPS_PER_MS = 0.012, EASE_MS = 70;
const TYPED = "input:not([type=radio]):not([type=checkbox]):not([type=range])";
const ORBITS = { ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0] };
const MOVES = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0] };
const calm = matchMedia("(prefers-reduced-motion: reduce)");

// A held key moves evenly: it adds steps over time, and each frame performs a fraction of the remaining steps.
class Glide {
  held = new Map();
  left = { move: [0, 0, 0], orbit: [0, 0, 0] };
  running = false;

  constructor(act) { this.act = act; }

  press(key, kind, step) {
    this.held.set(key, [kind, step]);
    this.add(kind, step, 1);
    if (this.running) return;
    this.running = true;
    this.last = performance.now();
    requestAnimationFrame((now) => this.frame(now));
  }

  add(kind, step, by) { this.left[kind] = this.left[kind].map((value, axis) => value + by * step[axis]); }

  frame(now) {
    const passed = Math.min(Math.max(now - this.last, 0), 100), share = calm.matches ? 1 : 1 - Math.exp(-passed / EASE_MS);
    this.last = now;
    for (const [kind, step] of this.held.values()) this.add(kind, step, passed * STEPS_PER_MS);
    let still = !this.held.size;
    for (const kind of ["move", "orbit"]) {
      if (Math.hypot(...this.left[kind]) < 1e-3) continue;
      still = false;
      this.act[kind](...this.left[kind].map((value) => share * value));
      this.left[kind] = this.left[kind].map((value) => (1 - share) * value);
    }
    this.running = !still;
    if (!still) requestAnimationFrame((next) => this.frame(next));
  }
}

export function attachKeys(act) {
  const glide = new Glide(act);
  document.addEventListener("keyup", (event) => glide.held.delete(keyOf(event)));
  window.addEventListener("blur", () => glide.held.clear());
  document.addEventListener("keydown", (event) => {
    const typing = event.target.closest(TYPED), way = historyOf(event), key = keyOf(event);
    if (way && !typing) { act[way](); event.preventDefault(); return; }
    if (isCommand(event) || document.querySelector("dialog[open]")) return;
    if (key === "Escape") { act.clear(); return; }
    if (typing) return;
    const on = (selector) => event.target.closest(selector);
    const keys = {
      "/": act.ask, "?": act.help, "[": () => act.step(-1), "]": () => act.step(1), "+": () => act.zoom(0.9), "=": () => act.zoom(0.9), "-": () => act.zoom(1 / 0.9),
      o: act.photo, f: act.fly, m: act.like, n: act.name, k: act.keep, v: act.path, p: act.frustums, g: act.mode, x: act.edit, u: act.parent, j: act.child,
      0: () => act.level("auto"), 1: () => act.level("whole"), 2: () => act.level("part"), 3: () => act.level("subpart"),
    };
    if (on("select")) return;
    const free = on("#view") || event.target === document.body;   // lists and radio buttons use the arrow keys and Home themselves
    if ((ORBITS[key] || key === "Home") && !free) return;
    if (key === "Home") act.home();
    else if (act.edited(key)) { /* a key of the edit bar */ }
    else if (ORBITS[key] || MOVES[key]) { if (!event.repeat) glide.press(key, ORBITS[key] ? "orbit" : "move", ORBITS[key] ?? MOVES[key]); }
    else if (keys[key]) keys[key]();
    else return;
    event.preventDefault();
  });
}
