// The strip of photographs, and the photograph shown over the view if the camera has the photograph's pose.

import * as api from "./api.js";
import { $, attachArrows, make } from "./elements.js";
import { picture } from "./pictures.js";

export class Photos {
  constructor(views, stand) {
    this.opacity = 0;
    this.views = views;
    $("views").replaceChildren(...views.map((view, number) => make("button", { type: "button", role: "option", "aria-selected": "false", tabindex: number ? "-1" : "0",
      "aria-label": `${view.name}${view.split === "test" ? ", held out" : ""}`, title: view.name, class: view.split, onclick: () => stand(number) },
    picture(api.thumbUrl(number), {}))));
    attachArrows($("views"));
    $("photo").addEventListener("load", () => { $("photo").style.visibility = "visible"; });
    $("photo").addEventListener("error", () => { $("photo").dataset.number = ""; });   // so that it is loaded again
  }

  cycle() { this.opacity = (this.opacity + 1) % 3; }

  // Align the photograph with the camera's frame.
  place(camera, width, height, panes) {
    const photo = $("photo"), number = camera.view;
    const each = width / panes, { s, x, y } = camera.frame(each, height);
    $("blend").setAttribute("aria-pressed", String(this.opacity > 0));
    photo.hidden = !this.opacity || number < 0;
    if (photo.hidden) return;
    if (photo.dataset.number !== String(number)) { photo.style.visibility = "hidden"; photo.src = api.photoUrl(number); photo.dataset.number = number; }   // until it is loaded, the browser would show the previous one
    photo.classList.toggle("whole", this.opacity === 2);
    Object.assign(photo.style, { left: `${x}px`, top: `${y}px`, width: `${s * camera.lens.w}px`, height: `${s * camera.lens.h}px` });
  }

  // Scroll to the first photograph of these, if none of them is visible.
  reveal(numbers) {
    const strip = $("views").getBoundingClientRect(), buttons = numbers.map((number) => $("views").children[number]);
    const isVisible = (button) => { const { left, right } = button.getBoundingClientRect(); return left >= strip.left && right <= strip.right; };
    if (!buttons.some(isVisible)) buttons[0]?.scrollIntoView({ block: "nearest", inline: "center" });
  }

  mark(number, shows = []) {
    const marked = `${number} ${shows}`;
    if (marked === this.marked) return;   // a scene may have thousands of photographs
    this.marked = marked;
    [...$("views").children].forEach((button, k) => {
      const chosen = k === number;
      if (chosen && button.getAttribute("aria-selected") !== "true") button.scrollIntoView({ block: "nearest", inline: "nearest" });
      button.setAttribute("aria-selected", String(chosen));
      button.tabIndex = chosen || (number < 0 && !k) ? 0 : -1;
      button.classList.toggle("shows", shows.includes(k));
    });
  }
}
