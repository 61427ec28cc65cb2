// The server's answers. The exported page has offline.js in this file's place, with the same names.

import { get, send } from "./http.js";

export const offline = false;
export const texts = [];   // what an exported page can answer

export const scene = async () => (await get("/api/scene")).json();
export const variant = async (name) => (await get(`/api/variant/${encodeURIComponent(name)}`)).json();
export const splats = async () => (await get("/api/splats")).arrayBuffer();
export const nodes = async (name) => (await get(`/api/nodes/${encodeURIComponent(name)}`)).arrayBuffer();
export const photoUrl = (number) => `/api/photo/${number}`;
export const thumbUrl = (number) => `/api/thumb/${number}`;
export const cropUrl = (variant, node) => `/api/crop/${encodeURIComponent(variant)}/${node}`;
export const sorter = () => new Worker("/static/sorter.js");

export const query = async (asked, signal) => (await send("/api/query", asked, { signal })).json();
export const like = async (asked, signal) => (await send("/api/like", asked, { signal })).json();
export const field = async (asked, signal) => (await send("/api/field", asked, { signal })).arrayBuffer();
export const pick = async (asked, signal) => (await send("/api/pick", asked, { signal })).json();
export const frame = async (asked, signal) => (await send("/api/frame", asked, { signal })).blob();
export const names = async (asked, version) =>
  (await send("/api/names", asked, { method: "PUT", headers: { "if-match": `"${version}"` } })).json();
export const saved = async (kind, asked) => (await send(`/api/export/${kind}`, asked)).blob();
