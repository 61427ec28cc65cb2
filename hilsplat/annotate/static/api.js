// Requests to the server. Each contains the scene state with which this page was loaded; the server refuses any other state.

import { $ } from "./elements.js";
import { get, send } from "./http.js";
import { follow, insist, restartWith } from "./stopped.js";

let state = "", unsaved = () => "";
export const tellUnsaved = (sentence) => { unsaved = sentence; };
const at = (path) => `${path}?of=${state}`;

export async function scene() {
  const described = await (await get("/api/scene")).json();
  state = described.of;
  restartWith(described.restart);
  return described;
}
export const labels = async () => (await get(at("/api/labels"))).json();
export const save = async (number, labels, version) =>
  (await insist(() => send(at(`/api/labels/${number}`), { labels }, { method: "PUT", headers: { "if-match": `"${version}"` } }), unsaved)).json();
export const ask = async (path, value) => (await insist(() => send(at(path), value), unsaved)).json();
export const photoUrl = (number) => at(`/api/photo/${number}`);
export const thumbUrl = (number) => at(`/api/thumb/${number}`);
export const exportUrl = (kind) => at(`/api/export/${kind}`);

// Check regularly whether annotations or files of the scene changed; the page keeps its loaded state until a reload.
export const watch = (labelled, failed) => follow(async () => (await get("/api/changes")).json(), async (now) => {
  if (now.of !== state || now.changed.length) {
    $("changed-what").textContent = `The scene has changed${now.changed.length ? ` (${now.changed.join(", ")})` : ""}. Reload to use the new files.`;
    $("changed").hidden = false;
  }
  await labelled(now.labels);
}, { failed, more: unsaved });
