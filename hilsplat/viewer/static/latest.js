// Run at most one request of a kind at a time; a new request replaces the waiting request.
export function latest(work) {
  let busy = false, waiting = null;
  return async function ask(...args) {
    if (busy) { waiting = args; return; }
    busy = true;
    try { await work(...args); } finally {
      busy = false;
      if (waiting) { const next = waiting; waiting = null; ask(...next); }
    }
  };
}

// Take steps one after another, in the order in which they were asked for, whatever the server's time for each.
export function inOrder(failed) {
  let last = Promise.resolve();
  return (step) => last = last.then(step).catch(failed);
}
