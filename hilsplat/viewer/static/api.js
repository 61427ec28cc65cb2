// Requests to the server. An exported page has offline.js instead, with the same exports.

import { get, send, streamed } from "./http.js";
import { insist, restartWith } from "./stopped.js";

export const offline = false;
export const texts = [], link = "";   // answered queries, and the part after # of the address, of an exported page

// Each request contains the scene state with which this page was loaded; the server refuses any other state.
let state = "";
// In a notebook, the page is a frame on another site and gets no cookie, so its address contains the token. Paths are
// relative, because a proxy may serve the page under any path.
const token = new URLSearchParams(location.search).has("embedded") ? new URLSearchParams(location.search).get("token") : "";
const named = new URLSearchParams(location.search).get("scene");
const at = (path, of = `of=${state}`) => `${path}?${of}${named ? `&scene=${encodeURIComponent(named)}` : ""}${token ? `&token=${token}` : ""}`;

// What the page cannot do without is requested again after a lost connection.
const loaded = (path, of) => insist(() => get(at(path, of)), () => "");

export async function scene() {
  const described = await (await loaded("api/scene", "")).json();
  state = described.of;
  restartWith(token ? "" : described.restart);
  return described;
}
export const scenes = async () => (await get(at("api/scenes"))).json();
export const changes = async () => (await get(at("api/changes", ""))).json();
export const variant = async (name) => (await loaded(`api/variant/${encodeURIComponent(name)}`)).json();
export const splats = async (chunk) => (await loaded(`api/splats/${chunk}`)).arrayBuffer();
export const nodes = async (name) => (await loaded(`api/nodes/${encodeURIComponent(name)}`)).arrayBuffer();
export const photoUrl = (number) => at(`api/photo/${number}`);
export const photo = async (number) => (await get(photoUrl(number))).blob();
export const thumbUrl = (number) => at(`api/thumb/${number}`);
export const cropUrl = (variant, node) => at(`api/crop/${encodeURIComponent(variant)}/${node}`);
export const sorter = () => new Worker("static/sorter.js");

export const query = async (asked, signal) => (await send(at("api/query"), asked, { signal })).json();
export const like = async (asked, signal) => (await send(at("api/like"), asked, { signal })).json();
export const field = async (asked, signal) => (await send(at("api/field"), { ...asked, order: "page" }, { signal })).arrayBuffer();
export const path = async (asked) => (await send(at("api/path"), asked)).json();
export const members = async (asked) => (await send(at("api/members"), asked)).arrayBuffer();
export const within = async (asked) => (await send(at("api/within"), asked)).arrayBuffer();
export const pick = async (asked, signal) => (await send(at("api/pick"), asked, { signal })).json();
export const frame = async (asked, signal) => (await send(at("api/frame"), asked, { signal })).blob();
export const names = async (asked, version) =>
  (await send(at("api/names"), asked, { method: "PUT", headers: { "if-match": `"${version}"` } })).json();
export const saved = async (kind, asked) => (await send(at(`api/export/${kind}`), asked)).blob();
export const savedInSteps = async (kind, asked, told, signal) => streamed(await send(at(`api/export/${kind}`), asked, { signal }), told);
