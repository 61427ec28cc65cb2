// Boxes and labels over the picture, as SVG.

import { shape } from "./elements.js";

const EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
const LETTER_PX = 8, LINE_PX = 16;   // size of a label
const isOutside = (at, width, height) => [width, height].some((side, axis) => at.every((point) => point[axis] < 0) || at.every((point) => point[axis] > side));

// Whether a box is in the picture, or around the camera.
export function inPicture(camera, corners, width, height) {
  const k = camera.intrinsics(width, height), at = corners.map((corner) => camera.project(corner, k)), before = at.filter(Boolean);
  return before.length > 0 && (before.length < at.length || !isOutside(at, width, height));
}

// panes: [{boxes: [{corners, kind, label, node, stroke}], frustums: [{corners, kind, number, name, label}]}], side by side in width x height CSS px; tools cover the top `covered` px.
export function drawOverlay(svg, camera, panes, width, height, covered = 0) {
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const made = [], each = width / panes.length, k = camera.intrinsics(each, height);
  panes.forEach((pane, number) => {
    const placed = [], group = shape("g", { transform: `translate(${number * each} 0)` });
    if (number) group.append(shape("path", { class: "split", d: `M0 0V${height}` }));
    for (const { corners, kind, number, name, label } of pane.frustums) {
      const at = corners.map((corner) => camera.project(corner, k));
      if (at.some((point) => !point) || isOutside(at, each, height)) continue;
      const [apex, ...rim] = at.map(([x, y]) => `${x.toFixed(1)} ${y.toFixed(1)}`), made = shape("path", { class: kind, d: `M${rim.join("L")}Z${rim.map((corner) => `M${apex}L${corner}`).join("")}`, "data-view": number ?? "" });
      if (name) made.append(shape("title", {}, name));
      group.append(made);
      if (label) group.append(shape("text", { x: at[0][0], y: at[0][1] }, label));
    }
    for (const { corners, kind, label: whole, node, stroke = null } of pane.boxes) {
      const at = corners.map((corner) => camera.project(corner, k));
      if (at.some((point) => !point) || isOutside(at, each, height)) continue;   // a point is null if it is behind the camera
      const d = EDGES.map(([a, b]) => `M${at[a][0].toFixed(1)} ${at[a][1].toFixed(1)}L${at[b][0].toFixed(1)} ${at[b][1].toFixed(1)}`).join("");
      group.append(shape("path", { d, class: "shadow" }), shape("path", { d, class: kind, "data-node": node, stroke }));
      const top = at.reduce((best, point) => point[1] < best[1] ? point : best);
      if (!whole) continue;
      const most = Math.max(8, Math.floor(each / LETTER_PX) - 1), label = whole.length > most ? `${whole.slice(0, most - 6)}…${whole.slice(-5)}` : whole;   // ends with the score
      const x = Math.max(4, Math.min(each - LETTER_PX * label.length, top[0])), right = x + LETTER_PX * label.length;
      let y = Math.max(covered + 14, top[1] - 6);
      while (placed.some((other) => x < other.right && other.x < right && Math.abs(y - other.y) < LINE_PX)) y += LINE_PX;   // below other labels
      placed.push({ x, right, y });
      group.append(shape("text", { x, y }, label));
    }
    if (pane.label) group.append(shape("text", { x: 12, y: height - 12 }, pane.label));
    made.push(group);
  });
  svg.replaceChildren(...made);
}
