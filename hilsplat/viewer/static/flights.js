// Camera moves to a photograph or a node, as a short flight if the painter is fast enough.

import { redraw, restyle } from "./drawing.js";
import { main, page } from "./state.js";

const calm = matchMedia("(prefers-reduced-motion: reduce)");
let flight = 0;

export function setMoving(now) {
  if (page.moving === now) return;
  page.moving = now;
  if (page.painter) page.painter.moving = now;
  if (!now) redraw();
}

export const touched = () => { flight++; setMoving(true); redraw(); };

export function goTo(target) {
  const mine = ++flight;
  if (calm.matches || page.painter.kind === "server" || page.slow) { page.camera = target; setMoving(false); redraw(); return; }
  const from = page.camera.copy(), begin = performance.now(), lasts = 450;
  setMoving(true);
  const next = (now) => {
    if (mine !== flight) return;
    const t = Math.min(1, Math.max(0, (now - begin) / lasts)), eased = t * t * (3 - 2 * t);
    page.camera = t < 1 ? from.between(target, eased) : target;
    if (t < 1) requestAnimationFrame(next); else setMoving(false);
    redraw();
  };
  requestAnimationFrame(next);
}

// Show cameras in real time, the last one always, then return to the present one; anything else that moves the camera ends it.
export function play(cameras, perSecond, ended) {
  const mine = ++flight, before = page.camera, begin = performance.now(), last = cameras.length - 1;
  let shown = -1;
  setMoving(true);
  const next = (now) => {
    const k = Math.max(0, Math.floor((now - begin) / 1000 * perSecond)), over = k > last && shown === last;
    shown = Math.min(k, last);
    if (mine === flight) page.camera = over ? before : cameras[shown];
    redraw();
    if (mine === flight && !over) { requestAnimationFrame(next); return; }
    setMoving(false);
    ended();
  };
  requestAnimationFrame(next);
}

export const halt = () => { flight++; };

export function stand(number) {
  goTo(page.camera.ofView(page.scene.views[number], number));
}

export const flyTo = (node) => {
  if (node < 0 || !main()) return;
  const { corners, size } = main().nodes[node], middle = [0, 1, 2].map((axis) => corners.reduce((sum, corner) => sum + corner[axis], 0) / corners.length);
  page.hover = -1;   // after the flight, the pointer is over another node
  restyle();
  goTo(page.camera.lookingAt(middle, Math.hypot(...size)));
};

export const step = (by) => {
  const count = page.scene.views.length, from = page.camera.view;
  stand(from < 0 ? nearestView() : (from + by + count) % count);
};

export function nearestView() {
  let best = 0, least = Infinity;
  page.scene.views.forEach((view, number) => {
    const other = page.camera.ofView(view);
    const away = Math.hypot(...other.c.map((v, k) => v - page.camera.c[k])) + page.scene.reach * (1 - other.R[2].reduce((sum, v, k) => sum + v * page.camera.R[2][k], 0));
    if (away < least) { least = away; best = number; }
  });
  return best;
}
