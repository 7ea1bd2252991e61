// Shows what is marked `data-renew` anew every 5 or so many seconds, as it would be loaded,
// unless somebody writes into it; and what lies on maps.
import { isSignedOut, loaded } from "./stream.js";

const EVERY_MS = 1000 * (document.querySelector("[data-renew]")?.dataset.renew || 5);
const shown = new Map([...document.querySelectorAll("[data-renew]")].map((part) => [part, part.innerHTML]));

const namesOf = ({ label, layers }) => JSON.stringify([label, ...layers.map(({ name }) => name)]);

let tag; // of the page as it is shown

function renewMap(element, scene) {
  const [before, after] = [element.dataset.scene, scene].map((text) => JSON.parse(text));
  if (namesOf(before) !== namesOf(after)) return location.reload(); // another map
  element.dataset.scene = scene;
  after.layers.forEach(({ name, items }, n) => {
    if (JSON.stringify(items) !== JSON.stringify(before.layers[n].items)) element.map?.show(name, items);
  });
}

export async function renew() {
  const answer = await loaded(tag);
  if (document.querySelector("dialog[open]")) return; // somebody acts
  if (isSignedOut(answer)) return location.reload();
  if (!answer?.ok) return;
  tag = answer.headers.get("ETag");
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
  for (const [part, before] of shown) {
    const other = fresh.getElementById(part.id);
    const writes = part.contains(document.activeElement) && document.activeElement.matches("input, select, textarea");
    if (!other || other.innerHTML === before) continue;
    if (writes) {
      tag = undefined;
      continue;
    }
    shown.set(part, other.innerHTML); // not as it stands on the page, where somebody opened a part of it
    part.replaceChildren(...other.childNodes);
  }
  for (const element of document.querySelectorAll("[data-scene]")) {
    const scene = fresh.getElementById(element.id)?.dataset.scene;
    if (scene && scene !== element.dataset.scene) renewMap(element, scene);
  }
}

setInterval(() => document.hidden || renew(), EVERY_MS);
