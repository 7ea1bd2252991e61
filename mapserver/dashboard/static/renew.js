// Shows what is marked `data-renew` anew every 5 or so many seconds, as it would be loaded,
// unless somebody writes into it; and what lies on maps.
import { renewParts } from "./morph.js";
import { isSignedOut, loaded } from "./stream.js";

const EVERY_MS = 1000 * (document.querySelector("[data-renew]")?.dataset.renew || 5);

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

// One request at a time: of two the earlier answer could come last.
let underWay;
export const renew = () => (underWay ??= renewNow().finally(() => (underWay = undefined)));

async function renewNow() {
  const asked = location.href;
  const answer = await loaded(tag);
  if (document.querySelector("dialog[open]") || asked !== location.href) return; // somebody acts, or wants something else
  if (isSignedOut(answer)) return location.reload();
  if (!answer?.ok) return;
  tag = answer.headers.get("ETag");
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
  if (!renewParts(fresh, [...document.querySelectorAll("[data-renew]")])) tag = undefined; // what is not shown yet is asked for again
  for (const element of document.querySelectorAll("[data-scene]")) {
    const scene = fresh.getElementById(element.id)?.dataset.scene;
    if (scene && scene !== element.dataset.scene) renewMap(element, scene);
  }
}

setInterval(() => document.hidden || renew(), EVERY_MS);
