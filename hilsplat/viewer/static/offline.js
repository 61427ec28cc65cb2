// What takes the place of api.js in an exported page: everything is in the page itself.

export const offline = true;

export class Refused extends Error {}

const held = (id) => document.getElementById(id).textContent.trim();
const data = JSON.parse(held("data"));
export const texts = data.answers.map((answer) => answer.text), opening = data.opening;

const unpacked = (id) => Uint8Array.from(atob(held(id)), (c) => c.charCodeAt(0)).buffer;

const image = (text) => text ? `data:image/jpeg;base64,${text}` : "data:,";
const none = async () => { throw new Refused("This page has no server."); };

export const scene = async () => data.scene;
export const variant = async () => data.variant;
export const splats = async () => unpacked("splats");
export const nodes = async () => unpacked("nodes");
export const photoUrl = (number) => image(data.photos[number]);
export const thumbUrl = photoUrl;
export const cropUrl = (variant, node) => image(data.crops[node]);
export const sorter = () => new Worker(URL.createObjectURL(new Blob([held("sorter")], { type: "text/javascript" })));

export async function query({ text }) {
  const plain = (words) => words.trim().toLowerCase().replace(/\s*>\s*/g, " > ");
  const found = data.answers.find((answer) => plain(answer.text) === plain(text));
  if (!found) throw new Refused(`This page was made with the answers to: ${texts.join(", ") || "nothing"}.`);
  return found;
}

export const changes = none, like = none, field = none, pick = none, frame = none, names = none, saved = none, savedInSteps = none;
