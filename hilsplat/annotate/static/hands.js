// Mouse, pen and touch on the photograph: one pointer draws with the tool, the right button or two fingers move, wheel and pinch zoom.

const STILL_PX = 10;   // a finger that moved less before the second one touched has not drawn

export function attachHands(sheet, { drawing, down, drag, up, cancel, hover, close }) {
  const host = sheet.host, pointers = new Map();
  let acting = false, apart = 0;

  host.addEventListener("pointerdown", (event) => {
    host.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, moved: 0 });
    if (pointers.size > 1) {
      if (acting) ([...pointers.values()][0].moved < STILL_PX ? cancel : up)();
      for (const pointer of pointers.values()) pointer.moved = STILL_PX;   // two fingers do not click
      acting = false; apart = 0;
      return;
    }
    acting = event.button === 0 && Boolean(drawing(event));
    if (acting) down(sheet.pixel(event), event);
  });

  host.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) { hover(sheet.pixel(event)); return; }
    const dx = event.clientX - last.x, dy = event.clientY - last.y;
    Object.assign(last, { x: event.clientX, y: event.clientY, moved: last.moved + Math.abs(dx) + Math.abs(dy) });
    if (acting) { for (const each of event.getCoalescedEvents?.() ?? [event]) drag(sheet.pixel(each)); return; }
    host.classList.add("moving");
    if (pointers.size > 1) {
      const [a, b] = [...pointers.values()], now = Math.hypot(a.x - b.x, a.y - b.y), box = host.getBoundingClientRect();
      if (apart) sheet.zoom(now / apart, (a.x + b.x) / 2 - box.left, (a.y + b.y) / 2 - box.top);
      apart = now;
      sheet.move(dx / 2, dy / 2);
    } else sheet.move(dx, dy);
  });

  const ended = (event) => {
    const last = pointers.get(event.pointerId);
    pointers.delete(event.pointerId);
    host.classList.remove("moving");
    if (acting) up();
    else if (event.type === "pointerup" && last?.moved < 4 && event.button === 0) down(sheet.pixel(event), event);
    acting = false;
  };
  host.addEventListener("pointerup", ended);
  host.addEventListener("pointercancel", ended);
  host.addEventListener("pointerleave", () => hover(null));
  host.addEventListener("dblclick", close);
  host.addEventListener("contextmenu", (event) => event.preventDefault());
  host.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = host.getBoundingClientRect();
    sheet.zoom(Math.exp(-0.0015 * event.deltaY * (event.deltaMode ? 30 : 1)), event.clientX - box.left, event.clientY - box.top);
  }, { passive: false });
}
