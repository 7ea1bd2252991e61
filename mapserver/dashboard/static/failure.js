// Steps through the seconds around a failure: picture, state, belief and place of the chosen moment. Words of robots are text here.
import { mark } from "./map/index.js";

const { instants, pictures } = JSON.parse(document.getElementById("seconds").textContent);
const [moment, seen, caption, now, when, belief, map] = ["moment", "seen", "seen-when", "now", "when", "belief", "map"].map((id) => document.getElementById(id));
const address = ([place]) => seen.src.replace(/\d+$/, place);

function show(chosen_ms) {
  const { x, y, tone, words, clock, since, heading_rad, picture, belief: believed } = instants.findLast(({ at_ms }) => at_ms <= chosen_ms);
  moment.setAttribute("aria-valuetext", `${clock}, ${since}: ${words}`);
  [now.textContent, now.className, when.textContent, belief.textContent] = [words, tone, `at ${clock}, ${since}`, believed];
  if (pictures.length) {
    const last = pictures[Math.max(0, picture)];
    seen.src = address(last);
    caption.textContent = `Left camera image of ${last[1]}`;
  }
  map?.map?.show("Chosen moment", x === null ? [] : [mark(x, y, `${clock}: ${words}`, { shape: "circle", tone, heading_rad })], false);
}

moment.addEventListener("input", () => show(moment.value));
for (const step of document.querySelectorAll("[data-at]"))
  step.addEventListener("click", () => {
    moment.value = step.dataset.at;
    show(step.dataset.at);
  });
// Before somebody steps: a picture that comes late would be that of another moment.
for (const begins of ["pointerenter", "focus"])
  moment.addEventListener(begins, () => pictures.forEach((each) => (new Image().src = address(each))), { once: true });
show(moment.defaultValue); // its value is a tenth of a second
