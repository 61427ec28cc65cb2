// The relevancy colour bar, and the number of Gaussians at or above the threshold.

import { $, counted } from "./elements.js";
import { levelIndex, main, panes, threshold } from "./state.js";
import { RAMP } from "./styles.js";

let shown = null;

export function showScale(style) {
  const has = style.high !== undefined && Boolean(panes[0].answer);
  $("scale").hidden = !has;
  if (!has || style === shown) return;
  shown = style;
  const least = threshold(), bar = $("scale-bar"), context = bar.getContext("2d"), pixels = context.createImageData(256, 1);
  for (let i = 0; i < 256; i++) {
    const value = style.low + i / 255 * (style.high - style.low), below = least !== null && value < least;
    pixels.data.set(below ? [28, 28, 28, 255] : [...RAMP.subarray(3 * i, 3 * i + 3), 255], 4 * i);
  }
  context.putImageData(pixels, 0, 0);
  $("scale-low").textContent = style.low.toFixed(2);
  $("scale-high").textContent = style.high.toFixed(2);
  $("scale-told").textContent = least === null ? "" : `${counted(above(style, least), "Gaussian")} at or above ${least.toFixed(2)}`;
}

function above(style, least) {
  if (style.ramp) return panes[0].values.reduce((count, value) => count + (value >= 255 * least), 0);
  const answer = panes[0].answer, level = levelIndex(answer);
  return main().nodes.reduce((sum, node, row) => sum + (node.level === level && answer.relevancy[row] >= least ? node.gaussians : 0), 0);
}
