// Requests to the server. Each contains the scene state with which this page was loaded; the server refuses any other state.

import { $ } from "./elements.js";
import { get, send } from "./http.js";

const POLL_MS = 4000;
let state = "";
const at = (path) => `${path}?of=${state}`;

export async function scene() {
  const described = await (await get("/api/scene")).json();
  state = described.of;
  return described;
}
export const labels = async () => (await get(at("/api/labels"))).json();
export const save = async (number, labels, version) =>
  (await send(at(`/api/labels/${number}`), { labels }, { method: "PUT", headers: { "if-match": `"${version}"` } })).json();
export const ask = async (path, value) => (await send(at(path), value)).json();
export const photoUrl = (number) => at(`/api/photo/${number}`);
export const thumbUrl = (number) => at(`/api/thumb/${number}`);
export const exportUrl = (kind) => at(`/api/export/${kind}`);

// Check regularly whether files of the scene changed; the page keeps its loaded state until a reload.
export async function watch() {
  while ($("changed").hidden) {
    await new Promise((done) => setTimeout(done, POLL_MS));
    if (document.hidden) continue;
    try {
      const now = await (await get("/api/changes")).json();
      if (now.of === state && !now.changed.length) continue;
      $("changed-what").textContent = `The scene has changed${now.changed.length ? ` (${now.changed.join(", ")})` : ""}. Reload to use the new files.`;
      $("changed").hidden = false;
    } catch { /* the server has stopped; the next change reports it */ }
  }
}
