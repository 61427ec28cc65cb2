// Files that the page gives away.

import * as api from "./api.js";
import { $ } from "./elements.js";
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
  const filmed = kind === "mp4" || kind === "gif";
  told(filmed ? "Filming: you can go on meanwhile." : kind === "masks" ? "Drawing the masks of all photographs…" : "Saving…");
  let blob;
  if (kind === "still") blob = await capture();
  else if (filmed) blob = await filming({ variant, style: wireStyle(style), format: kind, ...(kind === "gif" ? { side_px: Number($("gif-side").value) } : {}) }, told);
  else if (kind === "page") blob = await api.saved("page", { variant, texts, start: camera });
  else blob = await api.saved(kind, { variant, nodes });
  if (!blob) return;
  download(blob, `${name}-${KINDS[kind]}`);
  told(`Saved ${name}-${KINDS[kind]}, ${(blob.size / 1e6).toFixed(blob.size < 1e6 ? 2 : 1)} MB.`);
}

// One film at a time: how far it is, and a button that ends it. Nothing if it was ended.
async function filming(asked, told) {
  const ending = new AbortController(), buttons = $("save").querySelectorAll("[data-film]");
  const progress = (made, of) => { Object.assign($("film-made"), { value: made, max: of }); $("film-told").textContent = made < of ? `Film: ${made} of ${of} pictures` : "Film: packing"; };
  $("film-made").removeAttribute("value");
  $("film-told").textContent = "Film";
  $("film-end").onclick = () => ending.abort();
  $("film").hidden = false;
  for (const button of buttons) button.disabled = true;
  try { return await api.film(asked, progress, ending.signal); } catch (error) {
    if (error.name !== "AbortError") throw error;
    told("The film was cancelled.");
    return null;
  } finally {
    $("film").hidden = true;
    for (const button of buttons) button.disabled = false;
  }
}
