// Small pictures, loaded when visible and a few at a time: a browser has six connections to a server, and
// rendered pictures must not wait for a hundred crops.

import { make } from "./elements.js";

const AT_ONCE = 2;
const waiting = [];
let loading = 0;

const sight = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) if (isIntersecting) { sight.unobserve(target); waiting.push(target); }
  load();
}, { rootMargin: "100px" });

function load() {
  while (loading < AT_ONCE && waiting.length) {
    const image = waiting.shift();
    if (!image.isConnected) continue;
    loading++;
    for (const end of ["load", "error"]) image.addEventListener(end, () => { loading--; load(); }, { once: true });
    image.src = image.dataset.src;
  }
}

export function picture(src, attributes) {
  const image = make("img", { alt: "", "data-src": src, ...attributes });
  sight.observe(image);
  return image;
}
