// Keys. None acts while somebody types, and none takes a key that the browser or a control needs.

export function attachKeys(act) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    const typing = event.target.closest("input:not([type=radio]):not([type=checkbox]), textarea, [contenteditable]");
    if (event.key === "Escape") { act.clear(); return; }
    if (typing) return;
    const on = (selector) => event.target.closest(selector);
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    const moves = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, 1, 0], e: [0, -1, 0] }[event.key.toLowerCase()];
    const keys = {
      "/": act.ask, "?": act.help, "[": () => act.step(-1), "]": () => act.step(1), "+": () => act.zoom(0.9), "=": () => act.zoom(0.9), "-": () => act.zoom(1 / 0.9),
      o: act.photo, f: act.fly, m: act.like, n: act.name, g: act.mode, u: act.parent, j: act.child,
      0: () => act.level("auto"), 1: () => act.level("whole"), 2: () => act.level("part"), 3: () => act.level("subpart"),
    };
    if (on("select")) return;
    if (arrows && !on("#view") && event.target !== document.body) return;   // lists and radios have their own arrows
    if (arrows) act.orbit(...arrows);
    else if (moves) act.move(...moves);
    else if (keys[event.key] ?? keys[event.key.toLowerCase()]) (keys[event.key] ?? keys[event.key.toLowerCase()])();
    else return;
    event.preventDefault();
  });
}
