// Mouse, touch and wheel: drag orbits, two fingers or the right button move, wheel and pinch zoom, a tap picks,
// and a frame drawn with Alt held queries with the content of the frame. A tool, if one is chosen, takes the drag.

const TAP_PX = 4;

// tool: returns null, or { draw(points, done, event), taps } for a drag that draws instead of moving; taps: whether a tap does, too.
export function attach(host, { camera, changed, rested, tapped, pointed, tool }) {
  const pointers = new Map();
  let moved = 0, rest = 0, apart = 0, stroke = null, points = [];
  const touch = () => { clearTimeout(rest); changed(); rest = setTimeout(rested, 180); };
  const place = (event) => { const box = host.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
  const size = () => Math.min(host.clientWidth, host.clientHeight);

  host.addEventListener("pointerdown", (event) => {
    if (event.target.closest("button, select, details")) return;
    host.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button });
    stroke = pointers.size === 1 ? tool(event) : null;   // a second finger moves the camera instead
    moved = pointers.size === 1 ? 0 : TAP_PX;   // nor do two fingers tap
    points = [place(event)];
    apart = 0;
  });

  host.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId), box = host.getBoundingClientRect();
    if (!last) { pointed(event.clientX - box.left, event.clientY - box.top); return; }
    const dx = event.clientX - last.x, dy = event.clientY - last.y;
    moved += Math.abs(dx) + Math.abs(dy);
    Object.assign(last, { x: event.clientX, y: event.clientY });
    if (moved < TAP_PX) return;
    if (stroke) { points.push(place(event)); stroke.draw(points, false, event); return; }
    host.classList.add("dragging");
    if (pointers.size === 2) {
      const [a, b] = [...pointers.values()], now = Math.hypot(a.x - b.x, a.y - b.y);
      if (apart) camera().zoom(apart / Math.max(now, 1));
      apart = now;
      camera().move(-dx / size() / 2, -dy / size() / 2, 0);
    } else if (last.button === 2 || event.shiftKey) camera().move(-dx / size(), -dy / size(), 0);
    else camera().orbit(-3.2 * dx / size(), 3.2 * dy / size());
    touch();
  });

  const up = (event) => {
    const last = pointers.get(event.pointerId), box = host.getBoundingClientRect();
    pointers.delete(event.pointerId);
    host.classList.remove("dragging");
    if (stroke && event.type === "pointerup" && (moved >= TAP_PX || stroke.taps)) { stroke.draw(points, true, event); stroke = null; return; }
    if (event.type === "pointerup" && last && moved < TAP_PX && last.button === 0) tapped(event.clientX - box.left, event.clientY - box.top);
  };
  host.addEventListener("pointerup", up);
  host.addEventListener("pointercancel", up);
  host.addEventListener("pointerleave", () => pointed(-1, -1));
  host.addEventListener("contextmenu", (event) => event.preventDefault());
  host.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera().zoom(Math.exp(0.0012 * event.deltaY * (event.deltaMode ? 30 : 1)));
    touch();
  }, { passive: false });
  return touch;
}
