// Files that the page gives away.

import * as api from "./api.js";
import { wireStyle } from "./styles.js";

export function download(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

const KINDS = { ply: "selection.ply", boxes: "boxes.json", masks: "masks.zip", still: "picture.png", mp4: "flight.mp4", gif: "flight.gif", page: "page.html" };

export async function save(kind, { variant, nodes, style, capture, texts, camera, name, told }) {
  told(kind === "mp4" || kind === "gif" ? "Filming: a flight of five seconds takes up to a minute." : kind === "masks" ? "Drawing the masks of all photographs…" : "Saving…");
  let blob;
  if (kind === "still") blob = await capture();
  else if (kind === "mp4" || kind === "gif") blob = await api.saved("film", { variant, style: wireStyle(style), format: kind });
  else if (kind === "page") blob = await api.saved("page", { variant, texts, start: camera });
  else blob = await api.saved(kind, { variant, nodes });
  download(blob, `${name}-${KINDS[kind]}`);
  told(`Saved ${name}-${KINDS[kind]}, ${(blob.size / 1e6).toFixed(blob.size < 1e6 ? 2 : 1)} MB.`);
}
