// Replacement of api.js in an exported page, which contains all data.

export const offline = true;

export class Refused extends Error {}

const held = (id) => document.getElementById(id).textContent.trim();
const data = JSON.parse(held("data"));
const plain = (words) => words.trim().toLowerCase().replace(/\s*>\s*/g, " > ");
export const texts = data.asked.map((query) => query.text), { link } = data;

const unpacked = (id) => Uint8Array.from(atob(held(id)), (c) => c.charCodeAt(0)).buffer;

const image = (text) => text ? `data:image/jpeg;base64,${text}` : "data:,";
const none = async () => { throw new Refused("This exported page has no server, so this action is not available."); };

export const scene = async () => data.scene;
export const variant = async () => data.variant;
export const splats = async () => unpacked("splats");
export const nodes = async () => unpacked("nodes");
export const photoUrl = (number) => image(data.photos[number]);
export const thumbUrl = photoUrl;
export const cropUrl = (variant, node) => image(data.crops[node]);
export const sorter = () => new Worker(URL.createObjectURL(new Blob([held("sorter")], { type: "text/javascript" })));

export async function query({ text, level, threshold, view }) {
  const same = data.asked.map((asked, k) => plain(asked.text) === plain(text) ? k : -1).filter((k) => k >= 0);
  const found = data.answers[same.find((k) => data.asked[k].level === level && data.asked[k].threshold === threshold && data.asked[k].view === view) ?? same[0]];
  if (!found) throw new Refused(`This page contains only the answers to: ${texts.join(", ") || "nothing"}.`);
  return found;
}

export const scenes = none, changes = none, photo = none, like = none, field = none, pick = none, path = none, members = none, within = none, frame = none, names = none, saved = none, savedInSteps = none;
