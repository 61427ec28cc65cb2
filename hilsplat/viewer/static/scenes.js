// The scenes of the results folder, of which each opens in this page, on the same server.

import * as api from "./api.js";
import { $, make } from "./elements.js";
import { failed, options } from "./state.js";

function addressOf(name) {
  const search = new URLSearchParams({ scene: name });
  if (options.get("painter")) search.set("painter", options.get("painter"));
  return `${location.pathname}?${search}`;
}

async function list() {
  if (!$("scenes").open) return;
  try {
    const scenes = await api.scenes();
    $("scene-list").replaceChildren(...scenes.map(({ name, state, date, can_open, current }) => make("li", {},
      make("a", { href: can_open ? addressOf(name) : null, "aria-current": current ? "page" : null, "aria-disabled": can_open ? null : "true" },
        name, make("small", {}, [state, date].filter(Boolean).join(" · "))))));
  } catch (error) { failed(error); }
}

export function attachScenes() {
  $("scenes").hidden = api.offline || options.has("embedded");
  $("scenes").addEventListener("toggle", list);
}
