// A notice while the server is stopped. A server started again at the same port continues to serve this page, once the
// printed address, whose cookie all pages of the browser share, has been opened.

import { $, make } from "./elements.js";

const RETRY_MS = 2000, POLL_MS = 4000;
let command = "";

export const restartWith = (words) => { command = words; };
export const isStopped = (error) => error.status === 0 || error.status === 403;

export function showStopped(stopped, more = "") {
  if ($("stopped").hidden !== stopped && !more) return;
  $("stopped").hidden = !stopped;
  const how = command ? ["To continue, run ", make("code", {}, `${command} --port ${location.port}`), " and keep this page open."] : ["Run the cell of the notebook again."];
  $("stopped").replaceChildren(`The server has stopped. ${more}`, ...how);
}

// Send a request until a server answers it; `more` returns a sentence for the notice.
export async function insist(request, more) {
  for (;;) {
    try {
      const answer = await request();
      showStopped(false);
      return answer;
    } catch (error) {
      if (!isStopped(error)) throw error;
      showStopped(true, more());
      await new Promise((done) => setTimeout(done, RETRY_MS));
    }
  }
}

// Pass the server's news to `work` regularly while the page is visible; `more` is as in `insist`.
export async function follow(news, work, { failed = () => {}, more = () => "" }) {
  let wake = () => {};
  document.addEventListener("visibilitychange", () => wake());
  for (;;) {
    await new Promise((done) => { wake = done; setTimeout(done, POLL_MS); });
    if (document.hidden) continue;
    try {
      const now = await news();
      showStopped(false);
      await work(now);
    } catch (error) { if (isStopped(error)) showStopped(true, more()); else failed(error); }
  }
}
