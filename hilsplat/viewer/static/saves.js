// Saved files.

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

const KINDS = { "scene-ply": "scene.ply", "scene-spz": "scene.spz", ply: "selection.ply", spz: "selection.spz", boxes: "boxes.json", masks: "masks.zip", still: "picture.png", mp4: "flight.mp4", gif: "flight.gif", page: "page.html" };
const IN_STEPS = { masks: ["Masks", "photographs"], mp4: ["Film", "pictures"], gif: ["Film", "pictures"], page: ["Page", "pictures"] };
const sized = (bytes) => bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;

export async function save(kind, { variant, answerer, groups, removed, style, capture, flown, queries, link, name, told }) {
  const asked = {
    masks: { variant, groups, removed }, page: { variant, answerer, removed, asked: queries, link },
    mp4: { variant, removed, style: wireStyle(style), format: "mp4", side_px: Number($("mp4-side").value), ...flown },
    gif: { variant, removed, style: wireStyle(style), format: "gif", side_px: Number($("gif-side").value), ...flown },
  }[kind];
  told(asked ? "Saving in the background." : "Saving…");
  const blob = kind === "still" ? await capture() : asked ? await inSteps(kind, asked, told) : await api.saved(kind, kind.startsWith("scene") ? { removed } : { variant, groups, removed });
  if (!blob) return;
  download(blob, `${name}-${KINDS[kind]}`);
  told(`Saved ${name}-${KINDS[kind]}, ${sized(blob.size)}.`);
}

// Save one file at a time, with progress and a Cancel button; return null if cancelled.
async function inSteps(kind, asked, told) {
  const ending = new AbortController(), buttons = $("save").querySelectorAll("[data-long]"), [what, things] = IN_STEPS[kind];
  const progress = (made, of) => { Object.assign($("saving-made"), { value: made, max: of }); $("saving-told").textContent = made < of ? `${what}: ${made} of ${of} ${things}` : `${what}: finishing`; };
  $("saving-made").removeAttribute("value");
  $("saving-made").setAttribute("aria-label", what);
  $("saving-told").textContent = what;
  $("saving-end").onclick = () => ending.abort();
  $("saving").hidden = false;
  for (const button of buttons) button.disabled = true;
  try { return await api.savedInSteps(asked.format ? "film" : kind, asked, progress, ending.signal); } catch (error) {
    if (error.name !== "AbortError") throw error;
    told("Cancelled: nothing was saved.");
    return null;
  } finally {
    $("saving").hidden = true;
    for (const button of buttons) button.disabled = false;
  }
}
