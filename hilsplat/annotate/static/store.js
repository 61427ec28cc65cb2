// Annotations of all photographs: every change can be undone, and is saved at once under the version that was read.

import * as api from "./api.js";

export class Store {
  constructor({ changed, told }) {
    this.handlers = { changed, told };
    this.past = [];
    this.future = [];
    this.saving = Promise.resolve();
    this.unsaved = 0;
  }

  async load() {
    this.views = await api.labels();
    this.past = [];
    this.future = [];
    this.handlers.changed();
  }

  labels(number) { return this.views[number].labels; }
  has(number, id) { return this.labels(number).some((label) => label.id === id); }

  // Things of all photographs by id: the label of the first that shows each.
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
  step(from, to) { if (from.length) to.push(this.swap(from.pop())); }

  swap(after) {
    const before = after.map(([number]) => [number, this.labels(number)]);
    for (const [number, labels] of after) { this.views[number].labels = labels; this.save(number); }
    this.handlers.changed();
    return before;
  }

  save(number) {
    this.unsaved++;
    this.saving = this.saving.then(() => this.put(number)).finally(() => { this.unsaved--; this.handlers.changed(); });
  }

  async put(number) {
    const view = this.views[number], sent = view.labels;
    try {
      const kept = await api.save(number, sent, view.version);
      view.version = kept.version;
      if (view.labels === sent) view.labels = kept.labels;   // cut to their parents
    } catch (error) {
      this.handlers.told(error.message, true);
      if (error.status === 422 && view.labels === sent && this.past.length) {   // it makes no sense: take it back
        for (const [other, labels] of this.past.pop()) { this.views[other].labels = labels; if (other !== number) this.save(other); }
      } else if (error.status === 412) await this.load();
    }
  }
}
