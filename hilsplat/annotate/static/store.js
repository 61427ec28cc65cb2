// Annotations of all photographs. Each change can be undone. It is saved at once, together with the file version that was read.

import * as api from "./api.js";

export class Store {
  constructor({ changed, told }) {
    this.handlers = { changed, told };
    this.past = [];
    this.future = [];
    this.saving = Promise.resolve();
    this.waiting = 0;
    this.queued = new Set();    // photographs with a change that has not been sent
    this.refused = new Set();   // photographs whose last change the server could not save
    this.errors = new Set();    // since the last time that nothing was waiting: the page shows them together
  }

  // Read the annotations of all photographs; unsaved ones stay, except those of a photograph that another program has changed.
  async load(changed = -1) {
    const before = this.views, unsaved = (number) => number !== changed && (this.refused.has(number) || this.queued.has(number));
    this.views = (await api.labels()).map((view, number) => unsaved(number) ? before[number] : view);
    this.past = [];
    this.future = [];
    this.handlers.changed();
  }

  // The undo history survives a reload unless another program changed the annotations.
  get versions() { return this.views.map((view) => view.version).join(); }

  remember(key) {
    const steps = (entries) => entries.map(({ before }) => before);
    for (let kept = this.past; ; kept = kept.slice(Math.ceil(kept.length / 2))) {
      try {
        sessionStorage.setItem(key, JSON.stringify({ versions: this.versions, past: steps(kept), future: steps(this.future) }));
        return;
      } catch { if (!kept.length) { sessionStorage.removeItem(key); return; } }   // too large to store: keep only the latest half
    }
  }

  recall(key) {
    const kept = JSON.parse(sessionStorage.getItem(key) ?? "null");
    if (kept?.versions !== this.versions) return;
    const entries = (steps) => steps.map((before) => ({ before, unsaved: new Set() }));
    this.past = entries(kept.past);
    this.future = entries(kept.future);
    this.handlers.changed();
  }

  // Show what another page or program has saved.
  async follow(versions) {
    if (this.unsaved || versions.join() === this.versions) return;
    const loaded = this.saving.then(() => this.load());   // not while a change is being saved
    this.saving = loaded.catch(() => {});
    await loaded;
    this.handlers.told("The annotations were changed elsewhere and have been reloaded.");
  }

  // Wait until the server has every change.
  async saved() {
    while (this.waiting) await this.saving;
    if (this.refused.size) throw new Error("Some changes could not be saved: change something to save them again, then repeat this.");
  }

  get unsaved() { return this.waiting + this.refused.size; }
  labels(number) { return this.views[number].labels; }
  has(number, id) { return this.labels(number).some((label) => label.id === id); }

  // Return the objects of all photographs by id, with the label from the first photograph that shows each object.
  get things() {
    const found = new Map();
    for (const view of this.views) for (const label of view.labels) if (!found.has(label.id)) found.set(label.id, label);
    return found;
  }

  // after: [[number of the photograph, all its labels], ...]
  change(after) {
    this.past.push(this.swap(after));
    this.future = [];
  }

  undo() { this.step(this.past, this.future); }
  redo() { this.step(this.future, this.past); }
  step(from, to) { if (from.length) to.push(this.swap(from.pop().before)); }

  // Return a history entry: the previous labels, and the photographs whose change the server has not accepted yet.
  swap(after) {
    this.handlers.told("");   // the last message no longer applies
    const before = after.map(([number]) => [number, this.labels(number)]);
    for (const [number, labels] of after) { this.views[number].labels = labels; this.save(number); }
    this.handlers.changed();
    return { before, unsaved: new Set(after.map(([number]) => number)) };
  }

  save(number) {
    if (!this.waiting) this.errors.clear();
    for (const each of new Set([number, ...this.refused])) {
      this.waiting++;
      this.queued.add(each);
      this.saving = this.saving.then(() => this.put(each)).catch((error) => this.keep(each, error)).finally(() => { this.waiting--; this.handlers.changed(); });
    }
  }

  async put(number) {
    await null;   // wait until the change to be saved is in the history
    this.refused.delete(number);
    this.queued.delete(number);
    const view = this.views[number], sent = view.labels, entries = [...this.past, ...this.future];
    try {
      const kept = await api.save(number, sent, view.version);
      view.version = kept.version;
      if (view.labels === sent) view.labels = kept.labels;   // the server cuts labels to their parents
      for (const entry of entries) entry.unsaved.delete(number);
    } catch (error) {
      if (![400, 412, 422].includes(error.status)) throw error;
      this.report(error);
      if (error.status === 412) await this.load(number); else this.takeBack(number);
    }
  }

  report(error) { this.handlers.told([...this.errors.add(error.message)].join("\n"), true); }

  // The next change is saved with this one.
  keep(number, error) {
    this.refused.add(number);
    this.report(error);
  }

  // The server refused a change: undo it and all later ones.
  takeBack(number) {
    const first = this.past.findIndex((entry) => entry.unsaved.has(number));
    if (first < 0) { this.refused.add(number); return; }   // the history was lost since
    const refused = this.past.splice(first), touched = new Set();
    this.future = [];
    for (const { before } of refused.reverse()) for (const [other, labels] of before) { this.views[other].labels = labels; touched.add(other); }
    touched.delete(number);   // the server still has the previous labels of this photograph
    for (const other of touched) this.save(other);
  }
}
