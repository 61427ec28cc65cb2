// Painter that shows JPEG frames rendered by the server, for browsers in which WebGL is missing or runs in software.

import * as api from "./api.js";
import { latest } from "./latest.js";
import { wireStyle } from "./styles.js";

const MOST_PX = 4096;   // sides of pictures that the server renders

const asked = (camera, pane, [width, height], quality, image) =>
  ({ variant: pane.variant || "default", camera: camera.wire(width, height), style: wireStyle(pane.style), removed: pane.removed, quality, image });
const fetched = async (frame) => createImageBitmap(await api.frame(frame));

export class ServerPainter {
  kind = "server";

  constructor(host, onDrawn, onError) {
    this.canvas = document.createElement("canvas");
    host.prepend(this.canvas);
    this.context = this.canvas.getContext("2d");
    this.moving = false;
    this.drawn = 0; this.asked = 0; this.last = "";
    this.request = latest(async (...args) => {
      try { await this.fetch(...args); onDrawn(); } catch (error) { this.last = ""; onError(error); }
    });
  }

  async loadNodes() {}
  loadField() {}   // a frame request contains the text
  mark() {}        // and the marks
  get unfinished() { return this.asked > 0 && !this.last; }
  get settled() { return this.drawn === this.asked; }

  resize(width, height) {
    if (this.canvas.width === width && this.canvas.height === height) return;
    const before = this.canvas.width ? this.context.getImageData(0, 0, this.canvas.width, this.canvas.height) : null;
    Object.assign(this.canvas, { width, height });
    if (before) this.context.putImageData(before, 0, 0);
  }

  draw(camera, panes, width, height) {
    this.resize(width, height);
    const each = Math.floor(width / panes.length), scale = Math.min(this.moving ? 0.5 : 1, MOST_PX / Math.max(each, height));
    const size = [Math.max(1, Math.round(each * scale)), Math.max(1, Math.round(height * scale))];
    const frames = panes.map((pane) => asked(camera, pane, size, this.moving ? 60 : 85, "jpeg"));
    const key = JSON.stringify([width, height, frames]);
    if (key === this.last) return;
    this.last = key;
    this.request(frames, each, height, ++this.asked);
  }

  async fetch(frames, each, height, number) {
    const pictures = await Promise.all(frames.map(fetched));
    pictures.forEach((picture, k) => { this.context.drawImage(picture, k * each, 0, each, height); picture.close(); });
    this.drawn = number;
  }

  async capture(camera, panes, width, height) {
    const scale = Math.min(1, MOST_PX * panes.length / width, MOST_PX / height), each = Math.floor(scale * width / panes.length);
    const canvas = new OffscreenCanvas(each * panes.length, Math.round(scale * height)), context = canvas.getContext("2d");
    for (const [k, pane] of panes.entries()) context.drawImage(await fetched(asked(camera, pane, [each, canvas.height], 95, "png")), k * each, 0);
    return canvas.convertToBlob({ type: "image/png" });
  }
}
