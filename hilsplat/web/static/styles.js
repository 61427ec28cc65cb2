// The colours of all nodes, for both painters.

export const ANSWER = [255, 122, 0], CHOSEN = [58, 150, 255], HOVER = [255, 225, 70], SHARED = [255, 255, 255];
// Gaussians selected for editing, and the weight of their colour.
export const MARKED = [255, 0, 160], MARKED_SHARE = 0.7;
// Colours of kept queries, of which there are at most as many.
export const KEPT = [[0, 200, 140], [235, 120, 200], [70, 215, 235], [180, 215, 50], [160, 120, 255], [235, 80, 80],
  [0, 105, 75], [145, 45, 110], [15, 105, 145], [100, 120, 0], [80, 40, 180], [145, 25, 30]];
const STOPS = [[0, 0, 4], [31, 12, 72], [85, 15, 109], [136, 34, 106], [186, 54, 85], [227, 89, 51], [249, 140, 10], [249, 201, 50], [252, 255, 164]];

export const RAMP = (() => {
  const ramp = new Uint8Array(768);
  for (let i = 0; i < 256; i++) {
    const at = i / 255 * (STOPS.length - 1), k = Math.min(Math.floor(at), STOPS.length - 2);
    for (let c = 0; c < 3; c++) ramp[3 * i + c] = Math.round(STOPS[k][c] + (at - k) * (STOPS[k + 1][c] - STOPS[k][c]));
  }
  return ramp;
})();

// The ramp with dark grey below a threshold.
const cut = new Map();
function rampFrom(threshold) {
  if (threshold === null) return RAMP;
  if (!cut.has(threshold)) cut.set(threshold, RAMP.map((value, k) => Math.floor(k / 3) < 255 * threshold ? 28 : value));
  return cut.get(threshold);
}

// Colours that differ between neighbouring rows of the table.
export function colourOf(node) {
  const hue = (node * 0.61803398875) % 1, value = (n) => {
    const k = (n + hue * 12) % 12;
    return Math.round(255 * (0.58 - 0.36 * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  };
  return [value(0), value(8), value(4)];
}

export const LISTED = 24;   // answers with an entry in the list and a box
// Hits that are painted and saved; only the first few hits for a similarity query, because all nodes are ranked.
const PAINTED_ALIKE = 5;
export const shownHits = (answer) => answer?.route === "like" ? answer.hits.slice(0, PAINTED_ALIKE) : answer?.hits ?? [];

// Doubtful answers are painted paler.
export const isDoubtful = (answer) => Boolean(answer?.hits.length && (answer.doubts.length || (answer.route !== "like" && answer.hits[0].score < 0.5)));

const strength = (answer) => isDoubtful(answer) ? 0.5 : 1;

/*
 * outline: the nodes of a variant; answer: the current answer, or null; kept: [{answer, rgb}] of kept queries;
 * colour, mode: the page's settings; level: 0, 1 or 2, for colours by level; chosen, hover: nodes, or -1;
 * field: the {text, level} of a field relevancy, or null; threshold: minimum relevancy to paint, or null.
 */
export function styleOf({ outline, answer, colour, mode, level, chosen, hover, field, threshold = null, kept = [] }) {
  const nodes = outline?.nodes ?? [], table = new Uint8Array(4 * (nodes.length + 1));
  const set = (node, rgb, a) => { if (node >= 0 && node < nodes.length) table.set([...rgb, Math.round(255 * a)], 4 * (node + 1)); };
  let use = [true, true, true];
  const range = {};   // range of the relevancy colours
  if (colour === "field" && answer && field) return { table, use, mode: "plain", ramp: rampFrom(threshold), field, low: 0, high: 1 };
  if (colour === "nodes" || (colour === "relevancy" && answer)) {
    use = [0, 1, 2].map((each) => each === level);
    const own = nodes.map((_, node) => node).filter((node) => nodes[node].level === level);
    const values = own.map((node) => answer?.relevancy[node] ?? 0), [low, high] = values.reduce(([least, most], value) => [Math.min(least, value), Math.max(most, value)], [Infinity, -Infinity]);
    Object.assign(range, { low, high });
    own.forEach((node, k) => {
      if (colour === "relevancy" && threshold !== null && values[k] < threshold) return;
      const step = high > low ? Math.round(255 * (values[k] - low) / (high - low)) : 128;
      set(node, colour === "nodes" ? colourOf(node) : RAMP.subarray(3 * step, 3 * step + 3), colour === "nodes" ? 0.6 : 0.8);
    });
    if (colour === "nodes" || threshold === null) mode = "plain";
  } else if (colour === "answers" && (answer || kept.length)) {
    const hits = shownHits(answer), painted = new Set();
    for (const { answer: other, rgb } of kept) for (const { node } of shownHits(other)) { set(node, painted.has(node) ? SHARED : rgb, 0.62 * strength(other)); painted.add(node); }
    hits.forEach(({ node }, rank) => set(node, painted.has(node) ? SHARED : ANSWER, strength(answer) * (0.72 - 0.42 * rank / Math.max(hits.length, 4))));
    if (!hits.length && !painted.size) mode = "plain";
  } else if (chosen < 0 || colour === "none") mode = "plain";
  if (chosen >= 0 && colour !== "none") {
    if (colour === "nodes" || colour === "relevancy") use = use.map((used, k) => used || k === nodes[chosen]?.level);
    set(chosen, CHOSEN, 0.62);
  }
  if (hover >= 0 && hover !== chosen && colour !== "none") set(hover, HOVER, 0.45);
  return { table, use, mode, ramp: null, ...(colour === "relevancy" ? range : {}) };
}

export const base64 = (bytes) => {
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
};
const sent = new WeakMap();

// A style in the server's format; empty if nothing is changed.
export function wireStyle(style) {
  if (!sent.has(style)) {
    const plain = !style.ramp && style.mode === "plain" && style.table.every((v, k) => k % 4 !== 3 || v === 0);
    const colours = plain ? {} : style.ramp ? { ramp: base64(style.ramp), ...style.field } : { table: base64(style.table), use: style.use, mode: style.mode };
    sent.set(style, style.marked ? { ...colours, marked: style.marked } : colours);
  }
  return sent.get(style);
}
