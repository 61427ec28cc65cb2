// The annotation page; the server computes all regions.

import { ask, exportUrl, scene as described, tellUnsaved, watch } from "./api.js";
import { $, attachMenu, counted, LEVELS, make } from "./elements.js";
import { attachHands } from "./hands.js";
import { historyOf, isCommand, keyOf } from "./keys.js";
import { Sheet } from "./sheet.js";
import { Store } from "./store.js";
import { attachThings, fillForm, level, LEVEL, makeStrip, markStrip, setLevel, showTexts, showThings, under } from "./things.js";

const UNNAMED = "unnamed", NEAR_PX = 8, ID_STEPS = 2 ** 16, MOST_RADIUS = 500;
const sheet = new Sheet(), start = new URLSearchParams(location.hash.slice(1));
// The id of the chosen object, 0 for a new one, and the settings of a new one. A choice replaces this, so that a region
// whose reply is late still goes to the object for which it was drawn.
let aim = { id: 0, next: { text: "", level: 1, parent: null } };
let scene, number = 0;
let draft = [], stroke = null, cross = null, offer = null, working = Promise.resolve();
let clicks = [], frame = null, found = [], corner = null;   // of the segment tool; `corner` is the corner that is being moved

function tell(text, error = false) { $("status").textContent = text; $("status").classList.toggle("error", error); }
const store = new Store({ told: tell, changed: refresh });
const labels = () => store.labels(number);
const labelOf = (view, id) => store.labels(view).find((label) => label.id === id) ?? null;
const own = () => labelOf(number, aim.id);
const tool = () => document.querySelector("[name=tool]:checked").value;
const radius = () => Number($("radius").value);
// Requests run one after the other, because each region depends on the previous one.
let waiting = 0;   // number of pending requests whose result may have to be saved
const soon = (work) => {
  waiting++;
  markSaved();
  working = working.then(work).catch((error) => tell(error.message, true)).finally(() => { waiting--; markSaved(); });
  return working;
};
function markSaved() { document.body.dataset.saved = String(!store.unsaved && !waiting); }
tellUnsaved(() => store.unsaved || waiting ? "Your last changes are not saved yet. " : "");

// -- showing ---------------------------------------------------------------------------------------

function draw() {
  const brushes = tool() === "brush" || tool() === "erase";
  sheet.hand({ offer, draft, stroke, clicks, frame, corners: tool() === "choose" ? ringsShown() : [], cross: tool() === "choose" ? null : cross, brush: brushes ? radius() : 0 });
}

function refresh() {
  if (!scene || !store.views) return;
  if (aim.id && !own()) aimAt(0);
  fillForm(labels(), own(), aim.next);
  showThings(labels(), aim.id, choose);
  showTexts(store.things);
  markStrip(scene.views, store, number);
  $("undo").disabled = !store.past.length;
  $("redo").disabled = !store.future.length;
  $("carry").disabled = !scene.carries;
  $("saved").textContent = store.refused.size ? "Not saved: the next change is saved with this one." : store.unsaved ? "Saving…" : `Saved in ${scene.folder}.`;
  markSaved();
  sheet.things(labels(), aim.id);
  draw();
}

function aimAt(id, next = {}) { aim = { id, next: { ...aim.next, ...next } }; }

function choose(id, next = {}) {
  drop();
  aimAt(id, next);
  refresh();
}

function drop() {
  closePolygon();
  stroke = offer = frame = corner = null;
  clicks = found = [];
  $("offers-section").hidden = true;
}

function stand(to) {
  drop();
  number = (to + scene.views.length) % scene.views.length;
  aimAt(aim.id);
  const { size_hw } = scene.views[number];
  sheet.show(number, size_hw);
  $("radius").max = Math.min(MOST_RADIUS, Math.max(60, Math.max(...size_hw) / 20));
  $("picture").alt = scene.views[number].name;
  refresh();
  $("views").children[number].scrollIntoView({ block: "nearest", inline: "nearest" });
  tell(`${scene.views[number].name}${scene.views[number].split === "test" ? ", held out" : ""}`);
  try { history.replaceState(null, "", `${location.pathname}#view=${number}`); } catch { /* Safari allows 100 calls in 30 s */ }
}

function setTool(name) {
  document.querySelector(`[name=tool][value=${name}]`).checked = true;
  $("view").dataset.tool = name;
  drop();
  draw();
}

// -- regions ---------------------------------------------------------------------------------------

const edited = (label) => label.origin === "drawn" ? "drawn" : "edited";
const ringsOf = (view, id) => labelOf(view, id)?.polygons ?? null;

// An object has the same id in all photographs. A new id is larger than the others by a random number, because someone else
// may just have added an object to another photograph, which this page has yet to read.
function idFor(view, thing) {
  const same = (label) => label.text.toLowerCase() === thing.text.toLowerCase() && label.level === thing.level && label.parent === thing.parent;
  for (const [id, label] of store.things) if (thing.text !== UNNAMED && same(label) && !store.has(view, id)) return id;
  return Math.max(0, ...store.things.keys()) + 1 + Math.floor(ID_STEPS * Math.random());
}

// `mine` is what `aim` was when the object was drawn.
function add(view, thing, mine) {
  const label = { ...thing, id: idFor(view, thing) }, isCurrent = mine === aim;
  Object.assign(mine, { id: label.id, next: { ...mine.next, text: "" } });   // the next object has another text
  store.change([[view, [...store.labels(view), label]]]);
  if (isCurrent && label.text === UNNAMED) { $("text").focus(); $("text").select(); }
}

const reshaped = (view, id, polygons) => store.change([[view, store.labels(view).map((each) => each.id === id ? { ...each, polygons, origin: edited(each) } : each)]]);

async function region(ring, brush, view, mine) {
  const label = labelOf(view, mine.id), parent = label ? label.parent : labelOf(view, mine.next.parent)?.id ?? null;
  if (!label && brush?.erase) { tell("Select the thing to erase from.", true); return; }
  const made = await ask("/api/shape", { view, add: [...(label?.polygons ?? []), ...(ring ? [ring] : [])], stroke: brush, inside: parent ? ringsOf(view, parent) : null });
  if (!made.polygons.length) {
    if (label) remove(view, label.id); else tell("The shape has no pixel inside the photograph and its parent.", true);
  } else if (label) reshaped(view, label.id, made.polygons);
  else add(view, { ...mine.next, parent, text: mine.next.text || (mine === aim && $("text").value.trim()) || UNNAMED, polygons: made.polygons, origin: "drawn" }, mine);
}

function closePolygon() {
  const view = number, mine = aim, ring = draft.filter(([x, y], k) => !k || x !== draft[k - 1][0] || y !== draft[k - 1][1]);
  draft = [];
  if (ring.length > 2) soon(() => region(ring, null, view, mine));
  draw();
}

function listOffers(found, rest = null) {
  $("offers-section").hidden = !found.length;
  const preview = (each) => { offer = each?.polygons ?? rest; draw(); };
  $("offers").replaceChildren(...found.map((each) => make("li", {}, make("button", { type: "button", onclick: () => take(each), onpointerenter: () => preview(each), onpointerleave: () => preview(null), onfocus: () => preview(each), onblur: () => preview(null) },
    each.text ? `${each.text}, ${LEVEL(each)} (${each.what})` : `${LEVEL(each)} (${each.what})`))));
}

async function propose([x, y], view) {
  if (view !== number) return;
  tell("Looking for outlines…");
  const found = await ask("/api/at", { view, x, y });
  if (view !== number) return;
  listOffers(found);
  tell(found.length ? "Choose an outline; it stays a proposal until you accept or correct it." : `There is no ${scene.proposes.slice(0, -1)} at this pixel.`);
  $("offers").querySelector("button")?.focus();
}

// Clicks on one object (outside it with Alt), or a box around it.
async function segment() {
  if (!frame && !clicks.some(([, , inside]) => inside)) { draw(); return; }
  tell(`${scene.segments} is computing the outline…`);
  const asked = { clicks, frame }, view = number;
  const outlines = await ask("/api/segment", { view, ...(frame ? { box: boxOf(frame) } : { clicks }) });
  if (view !== number || asked.clicks !== clicks || asked.frame !== frame) return;
  found = outlines;
  offer = found[0]?.polygons ?? null;
  listOffers(found, offer);
  tell(found.length ? "Press Enter to accept this outline, or choose another one on the left. Click to include more, Alt-click to exclude." : "No outline was found.");
  draw();
}

const boxOf = ([[a, b], [c, d]]) => [Math.min(a, c), Math.min(b, d), Math.max(a, c), Math.max(b, d)];

function clicked(at, inside) {
  frame = null;
  clicks = [...clicks, [...at, inside]];
  draw();
  soon(segment);
}

// -- corners of the chosen outline -----------------------------------------------------------------

// A corner moved before is part of the outline, although its reply may be late.
const ringsShown = () => own() ? corner?.rings ?? own().polygons : [];

function cornerAt(at) {
  const rings = ringsShown();
  let best = null, least = NEAR_PX;
  rings.forEach((ring, r) => ring.forEach(([x, y], k) => {
    const away = Math.hypot(x - at[0], y - at[1]) * sheet.scale;
    if (away < least) { least = away; best = { r, k }; }
  }));
  return best && { ...best, rings: rings.map((ring) => ring.map((point) => [...point])) };
}

// The server computes the new outline and cuts it to the parent.
function reshape(rings) {
  const { id, parent } = own(), view = number, moved = corner;
  soon(async () => {
    const made = await ask("/api/shape", { view, add: rings, stroke: null, inside: parent ? ringsOf(view, parent) : null });
    if (made.polygons.length) reshaped(view, id, made.polygons);
  }).then(() => { if (corner === moved) corner = null; draw(); });
}

// Pressing on a side of the outline adds a corner there.
function sideAt(at) {
  const rings = ringsShown();
  let best = null, least = NEAR_PX;
  rings.forEach((ring, r) => ring.forEach(([x, y], k) => {
    const [u, v] = ring[(k + 1) % ring.length], length = Math.hypot(u - x, v - y) || 1, t = Math.max(0, Math.min(1, ((at[0] - x) * (u - x) + (at[1] - y) * (v - y)) / length ** 2));
    const away = Math.hypot(x + t * (u - x) - at[0], y + t * (v - y) - at[1]) * sheet.scale;
    if (away < least) { least = away; best = { r, k: k + 1 }; }
  }));
  return best && { ...best, rings: rings.map((ring, r) => r === best.r ? [...ring.slice(0, best.k), at, ...ring.slice(best.k)] : ring) };
}

function take(each) {
  const above = own(), parent = above?.level === each.level - 1 ? above.id : null;
  drop();
  add(number, { text: each.text || aim.next.text || UNNAMED, level: each.level, parent, polygons: each.polygons, origin: "proposed" }, aim);
  const orphan = above && above.level < each.level && !parent;
  tell(orphan ? `Proposed without a parent: the parent of a ${LEVEL(each)} is a ${LEVELS[each.level - 2]}, but ${above.text} is a ${LEVEL(above)}.` : "Proposed: accept (A), correct or delete it.");
}

async function carry(view) {
  tell("Transferring things from other photographs…");
  await store.saved();
  const ids = [...store.things.keys()].filter((id) => !store.has(view, id));
  if (!ids.length) { tell("All things from other photographs are already in this one.", true); return; }
  const found = (await ask("/api/carry", { ids, view })).filter(({ id }) => !store.has(view, id));   // one may be drawn by now
  if (found.length) store.change([[view, [...store.labels(view), ...found]]]);
  tell(found.length ? `${found.length} proposed: accept (A), correct or delete each.` : "No accepted thing from another photograph is visible here.");
}

const transfer = (view = number) => soon(() => carry(view));

// -- things ----------------------------------------------------------------------------------------

// A change of an object's text, level or parent applies to all photographs.
function edit(patch) {
  if (!own()) { Object.assign(aim.next, patch); refresh(); return; }
  const { id } = aim, after = [];
  store.views.forEach((view, k) => {
    if (!store.has(k, id)) return;
    const mine = { ...patch };
    if (mine.parent && !store.has(k, mine.parent)) mine.parent = null;
    after.push([k, view.labels.map((label) => label.id === id ? { ...label, ...mine } : label)]);
  });
  store.change(after);
}

function setText() {
  const text = $("text").value.trim();
  if (own() && !text) { refresh(); return; }
  edit({ text });
}

function accept() {
  const right = new Set();
  for (let label = own(); label; label = labels().find((each) => each.id === label.parent)) right.add(label.id);
  store.change([[number, labels().map((label) => right.has(label.id) && label.origin === "proposed" ? { ...label, origin: "accepted" } : label)]]);
  tell(right.size > 1 ? "Accepted, with its ancestors." : "Accepted.");
}

function step(way) {
  if (way === "undo" && draft.length) { draft = draft.slice(0, -1); draw(); return; }
  const before = store[way === "undo" ? "past" : "future"].at(-1)?.before ?? [];
  store[way]();
  if (before.length && !before.some(([view]) => view === number)) stand(before[0][0]);
}

function remove(view = number, id = aim.id) {
  const gone = new Set([id, ...under(store.labels(view), id)]);
  store.change([[view, store.labels(view).filter((label) => !gone.has(label.id))]]);
}

function fresh(child = false) {
  const above = own();
  const next = { ...aim.next, text: "", ...(child && above && above.level < 3 ? { level: above.level + 1, parent: above.id } : {}) };
  if (!labelOf(number, next.parent)) next.parent = null;
  choose(0, next);
  $("text").focus();
}

async function take_in(files) {
  const given = await Promise.all(files.map(async (file) => ({ name: file.name, text: await file.text() })));
  let before, reply;
  do {   // the reply replaces all labels of a photograph, so it must contain what was changed meanwhile
    await store.saved();
    before = store.views.map(({ labels }) => labels);
    reply = await ask("/api/import", { files: given });
  } while (store.views.some(({ labels }, number) => labels !== before[number]));
  const { views, added, known, notes } = reply;
  const after = Object.entries(views).map(([number, labels]) => [Number(number), labels]);
  if (after.length) store.change(after);
  tell(`${counted(added, "label")} imported into ${counted(after.length, "photograph")}${known ? `; already present: ${known}` : ""}.${notes.slice(0, 3).map((note) => ` ${note}.`).join("")}${notes.length > 3 ? ` ${notes.length - 3} more notes.` : ""}`);
}

// -- input -----------------------------------------------------------------------------------------

function down(at, event) {
  $("view").focus({ preventScroll: true });
  const view = number;
  cross = at;
  if (tool() === "choose" && corner) return;
  if (tool() === "choose") {
    const near = event?.altKey ? cornerAt(at) : null;
    if (near) { const rings = near.rings.map((ring, r) => r === near.r ? ring.filter((_, k) => k !== near.k) : ring).filter((ring) => ring.length > 2); if (rings.length) reshape(rings); return; }
    const hit = event && document.elementFromPoint(event.clientX, event.clientY)?.closest("[data-id]");
    choose(hit ? Number(hit.dataset.id) : 0);
  } else if (tool() === "polygon") {
    const near = draft.length > 2 && Math.hypot(at[0] - draft[0][0], at[1] - draft[0][1]) * sheet.scale < NEAR_PX;
    if (near) closePolygon(); else draft = [...draft, at];
  } else if (tool() === "segment") {
    if (event && !event.altKey) frame = [at, at]; else clicked(at, !event?.altKey);
  } else if (tool() === "propose") soon(() => propose(at, view));
  else stroke = { points: [at], radius: radius(), erase: tool() === "erase" };
  draw();
}

function drag(at) {
  cross = at;
  if (corner) { corner.rings[corner.r][corner.k] = at; corner.moved = true; }
  if (tool() === "segment" && frame) frame = [frame[0], at];
  const last = stroke?.points.at(-1);
  if (stroke && (at[0] !== last[0] || at[1] !== last[1])) stroke.points.push(at);
  draw();
}

function up() {
  if (corner) { if (corner.moved) reshape(corner.rings); else corner = null; draw(); return; }
  if (tool() === "segment" && frame) {
    const [[a, b], [c, d]] = frame;
    if (Math.hypot(c - a, d - b) * sheet.scale < NEAR_PX) { clicked([a, b], true); return; }
    clicks = [];
    soon(segment);
    return;
  }
  const done = stroke, view = number, mine = aim;
  if (done) soon(() => region(null, done, view, mine)).then(() => { if (stroke === done) stroke = null; draw(); });
}

// Forget what the first of two fingers began.
function cancel() {
  if (tool() === "polygon") draft = draft.slice(0, -1);
  stroke = frame = corner = null;
  draw();
}

// With the choosing tool, dragging the chosen outline moves a corner; dragging elsewhere moves the photograph.
function grabbed(event) {
  if (tool() !== "choose" || !own() || event.altKey) return false;
  const at = sheet.pixel(event);
  corner = cornerAt(at) ?? sideAt(at);
  return corner;
}

attachHands(sheet, { drawing: (event) => tool() !== "choose" || grabbed(event), down, drag, up, cancel, close: closePolygon, hover: (at) => { cross = at; draw(); } });
attachThings(choose);
attachMenu($("save"));

function escape() {
  if (draft.length) draft = [];
  else if (stroke || clicks.length || frame || !$("offers-section").hidden) drop();
  else if (aim.id) choose(0);
  draw();
}

document.addEventListener("keydown", (event) => {
  if (document.querySelector("dialog[open]")) return;
  if (event.key === "Escape") { escape(); $("view").focus(); return; }
  const typing = event.target.closest("input:not([type=radio]):not([type=range]), select");
  const key = keyOf(event), way = historyOf(event);
  const isTyped = typing?.id === "text" && typing.value !== (own() ?? aim.next).text;   // the browser undoes typing
  if (way && !isTyped) { step(way); event.preventDefault(); return; }
  if (typing) { if (event.key === "Enter" && event.target.id === "text") { event.target.blur(); $("view").focus(); event.preventDefault(); } return; }
  if (isCommand(event)) return;
  const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key], onView = event.target === $("view") || event.target === document.body;
  const by = event.shiftKey ? 10 : 1;
  const keys = {
    v: () => setTool("choose"), p: () => setTool("polygon"), b: () => setTool("brush"), e: () => setTool("erase"), x: () => scene.proposes && setTool("propose"), s: () => scene.segments ? setTool("segment") : tell("Outlining clicked things needs masks of this scene made by a SAM that is installed here."),
    i: () => tool() === "segment" && cross && clicked(cross, true), o: () => tool() === "segment" && cross && clicked(cross, false),
    n: () => fresh(), j: () => fresh(true), t: () => { $("text").focus(); $("text").select(); }, a: () => own()?.origin === "proposed" && accept(), c: () => scene.carries && transfer(),
    Delete: () => own() && remove(), Backspace: () => { draft = draft.slice(0, -1); draw(); }, "[": () => stand(number - 1), "]": () => stand(number + 1),
    ",": () => resize(-1), ".": () => resize(1), "+": () => sheet.zoom(1.25), "=": () => sheet.zoom(1.25), "-": () => sheet.zoom(0.8), 0: () => sheet.fit(), "?": () => $("help").showModal(),
    1: () => pickLevel(1), 2: () => pickLevel(2), 3: () => pickLevel(3),
  };
  if (onView && arrow) { cross = sheet.inside((cross ?? sheet.size.map((side) => side / 2)).map((value, k) => value + by * arrow[k])); drag(cross); }
  else if (onView && key === " ") { down(cross ?? sheet.inside(sheet.size.map((side) => side / 2)), null); if (stroke) up(); }
  else if (onView && key === "Enter") { if (tool() === "segment") { if (found.length) take(found[0]); } else closePolygon(); }
  else if (keys[key] && !(event.target.closest("button, [role=treeitem]") && key === "Enter")) keys[key]();
  else return;
  event.preventDefault();
});

const resize = (by) => { $("radius").value = radius() + by; draw(); };
const pickLevel = (value) => { setLevel(value); levelChanged(); };
// A new level clears the parent, which must be one level above.
const levelChanged = () => edit({ level: level(), parent: null });

$("thing").addEventListener("submit", (event) => event.preventDefault());
$("text").addEventListener("change", setText);
for (const radio of document.querySelectorAll("[name=level]")) radio.addEventListener("change", levelChanged);
$("parent").addEventListener("change", () => edit({ parent: Number($("parent").value) || null }));
for (const radio of document.querySelectorAll("[name=tool]")) radio.addEventListener("change", () => setTool(tool()));
for (const [id, work] of Object.entries({ new: () => fresh(), child: () => fresh(true), accept, delete: () => remove(), undo: () => step("undo"), redo: () => step("redo"),
  carry: () => transfer(), reload: () => location.reload(), import: () => $("file").click(), "help-button": () => $("help").showModal() })) $(id).addEventListener("click", work);
$("file").addEventListener("change", () => { const files = [...$("file").files]; $("file").value = ""; $("save").open = false; soon(() => take_in(files)); });
document.addEventListener("dragover", (event) => event.preventDefault());
document.addEventListener("drop", (event) => { event.preventDefault(); const files = [...event.dataTransfer.files]; if (files.length) soon(() => take_in(files)); });
$("radius").addEventListener("input", draw);
window.addEventListener("pagehide", () => { if (store.views) store.remember(scene.folder); });
window.addEventListener("beforeunload", (event) => { if (store.unsaved || waiting || draft.length) event.preventDefault(); });

async function begin() {
  scene = await described();
  for (const link of document.querySelectorAll("[data-export]")) link.href = exportUrl(link.dataset.export);
  const name = scene.name.split("/").at(-1);
  document.title = `Annotate ${name} · hilsplat`;
  $("propose-label").hidden = !scene.proposes;
  $("segment-label").hidden = !scene.segments;
  $("about").textContent = `${scene.name}${scene.proposes ? `. Proposals: ${scene.proposes}` : ""}${scene.carries ? ", things from other photographs" : ""}.`;
  $("scores").hidden = !scene.scores;
  $("scores").textContent = `mIoU: ${scene.scores}.`;
  makeStrip(scene.views, stand);
  await store.load();
  store.recall(scene.folder);
  const first = store.views.findIndex((view) => view.labels.length);
  stand(Number(start.get("view") ?? Math.max(0, first)) || 0);
  setTool("choose");
  if (first < 0) tell("First annotation: 1. type what you see, 2. choose polygon (P) or brush (B) and draw around it, 3. press Enter. It is saved at once.");
  document.body.dataset.ready = "yes";
  watch((versions) => store.follow(versions), (error) => tell(error.message, true));
}

globalThis.hilsplat = { store, sheet };   // for tests
begin().catch((error) => { tell(error.message, true); document.body.dataset.ready = "failed"; });
