// The photograph with its outlines: zoom and pixel coordinates.

import { photoUrl } from "./api.js";
import { $, shape } from "./elements.js";
import { colourOf } from "./styles.js";

const MOST_CORNERS = 600;   // outlines with more corners are drawn without corners, which would be too close together
const RETRY_MS = 2000;
export const colour = (id) => `rgb(${colourOf(id).join(" ")})`;

// Vertices are whole pixels; their centres are at .5.
export const outline = (polygons) => polygons.map((ring) => `M${ring.map(([x, y]) => `${x + 0.5} ${y + 0.5}`).join("L")}Z`).join("");

export class Sheet {
  constructor() {
    this.host = $("view");
    this.scale = 1;
    this.x = this.y = 0;
    new ResizeObserver(() => this.fit()).observe(this.host);
    $("picture").addEventListener("load", () => { $("picture").hidden = false; });
    $("picture").addEventListener("error", () => setTimeout(() => { $("picture").src = photoUrl(this.number); }, RETRY_MS));
  }

  show(number, [height, width]) {
    this.size = [width, height];
    this.number = number;
    $("picture").hidden = true;   // until it is loaded, the browser would show the previous photograph
    $("picture").src = photoUrl(number);
    for (const each of [$("picture"), $("drawing")]) { each.setAttribute("width", width); each.setAttribute("height", height); }
    $("drawing").setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.fit();
  }

  fit() {
    if (!this.size) return;
    const { clientWidth: w, clientHeight: h } = this.host;
    this.scale = this.fitting = Math.min(w / this.size[0], h / this.size[1]);
    this.x = (w - this.scale * this.size[0]) / 2;
    this.y = (h - this.scale * this.size[1]) / 2;
    this.place();
  }

  place() {
    $("sheet").style.transform = `translate(${this.x}px, ${this.y}px) scale(${this.scale})`;
    $("sheet").style.setProperty("--px", 1 / this.scale);
    $("sheet").classList.toggle("near", this.scale > 2);
  }

  move(dx, dy) { this.x += dx; this.y += dy; this.place(); }

  zoom(factor, x = this.host.clientWidth / 2, y = this.host.clientHeight / 2) {
    const scale = Math.min(40, Math.max(Math.min(0.1, this.fitting), this.scale * factor)), by = scale / this.scale;
    this.x = x - by * (x - this.x);
    this.y = y - by * (y - this.y);
    this.scale = scale;
    this.place();
  }

  // Pixel of the photograph at a position on the page, clamped to the photograph.
  pixel(event) {
    const box = this.host.getBoundingClientRect();
    return this.inside([(event.clientX - box.left - this.x) / this.scale, (event.clientY - box.top - this.y) / this.scale]);
  }

  inside(at) { return at.map((value, k) => Math.max(0, Math.min(this.size[k] - 1, Math.floor(value)))); }

  // Draw the objects, which change rarely.
  things(labels, chosen) {
    $("outlines").replaceChildren(...[...labels].sort((a, b) => a.level - b.level).map((label) => shape("path", { d: outline(label.polygons), "data-id": label.id,
      class: `thing ${label.origin === "proposed" ? "proposed" : ""} ${label.id === chosen ? "chosen" : ""}`, fill: colour(label.id), stroke: colour(label.id) })));
  }

  // Draw the unfinished shape, at most once per frame.
  hand(state) {
    if (!this.waiting) requestAnimationFrame(() => { const last = this.waiting; this.waiting = null; this.drawHand(last); });
    this.waiting = state;
  }

  drawHand({ offer, draft, stroke, clicks, frame, corners, cross, brush }) {
    const made = [], middle = ([x, y]) => `${x + 0.5} ${y + 0.5}`, arm = 9 / this.scale;
    if (offer) made.push(shape("path", { d: outline(offer), class: "offer" }));
    if (corners.length) made.push(shape("path", { d: outline(corners), class: "draft" }));
    if (corners.flat().length <= MOST_CORNERS) for (const [x, y] of corners.flat()) made.push(shape("circle", { cx: x + 0.5, cy: y + 0.5, r: 3.5 / this.scale, class: "corner" }));
    if (frame) made.push(shape("path", { d: `M${middle(frame[0])}H${frame[1][0] + 0.5}V${frame[1][1] + 0.5}H${frame[0][0] + 0.5}Z`, class: "draft" }));
    for (const [x, y, inside] of clicks) made.push(shape("circle", { cx: x + 0.5, cy: y + 0.5, r: 5 / this.scale, class: inside ? "inside" : "outside" }));
    if (draft.length) made.push(shape("path", { d: `M${draft.map(middle).join("L")}${draft.length > 2 ? "Z" : ""}`, class: "draft" }), shape("circle", { cx: draft[0][0] + 0.5, cy: draft[0][1] + 0.5, r: 4 / this.scale, class: "draft" }));
    if (stroke) made.push(shape("path", { d: `M${[...stroke.points, stroke.points.at(-1)].map(middle).join("L")}`, class: `stroke ${stroke.erase ? "erase" : ""}`, "stroke-width": 2 * stroke.radius + 1 }));
    if (cross && brush) made.push(shape("circle", { cx: cross[0] + 0.5, cy: cross[1] + 0.5, r: brush, class: "cross" }));
    else if (cross) made.push(shape("path", { d: `M${cross[0] + 0.5 - arm} ${cross[1] + 0.5}h${2 * arm}M${cross[0] + 0.5} ${cross[1] + 0.5 - arm}v${2 * arm}`, class: "cross" }));
    $("hand").replaceChildren(...made);
  }
}
