// Shows what is marked `data-renew` anew every 5 or so many seconds, as it would be loaded,
// unless somebody writes into it; and what lies on maps.
import { isSignedOut, loaded } from "./stream.js";
import { arrange } from "./table.js";

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

// Makes a node like another of its kind. What is the same stays: focus, what somebody opened, a row under the pointer.
function morph(node, other) {
  const isTemplate = node.nodeName === "TEMPLATE"; // what is in it is compared by nobody
  if (node.isEqualNode(other) && !isTemplate) return;
  if (node.nodeName !== other.nodeName || node.nodeType !== Node.ELEMENT_NODE || isTemplate) return node.replaceWith(other);
  for (const { name } of [...node.attributes]) if (!other.hasAttribute(name) && name !== "open") node.removeAttribute(name);
  for (const { name, value } of other.attributes) if (node.getAttribute(name) !== value) node.setAttribute(name, value);
  morphChildren(node, other);
}

function morphChildren(node, other) {
  const ids = new Set([...other.children].map(({ id }) => id));
  for (const child of [...node.children]) if (child.id && !ids.has(child.id)) child.remove();
  const known = new Map([...node.children].map((child) => [child.id, child]));
  let at = node.firstChild;
  for (const fresh of [...other.childNodes]) {
    const own = fresh.id ? known.get(fresh.id) : at?.id ? null : at;
    if (own && own === at) at = at.nextSibling;
    else (own && node.moveBefore ? node.moveBefore : node.insertBefore).call(node, own ?? fresh, at); // moveBefore keeps the focus
    if (own) morph(own, fresh);
  }
  while (at) {
    const next = at.nextSibling;
    at.remove();
    at = next;
  }
}

export async function renew() {
  const asked = location.href;
  const answer = await loaded(tag);
  if (document.querySelector("dialog[open]") || asked !== location.href) return; // somebody acts, or wants something else
  if (isSignedOut(answer)) return location.reload();
  if (!answer?.ok) return;
  tag = answer.headers.get("ETag");
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
  arrange(fresh);
  for (const part of document.querySelectorAll("[data-renew]")) {
    const other = fresh.getElementById(part.id);
    const writes = part.contains(document.activeElement) && document.activeElement.matches("input:not([type=checkbox]), select, textarea");
    if (writes) tag = undefined; // what is not shown yet is asked for again
    else if (other) morph(part, other);
  }
  for (const element of document.querySelectorAll("[data-scene]")) {
    const scene = fresh.getElementById(element.id)?.dataset.scene;
    if (scene && scene !== element.dataset.scene) renewMap(element, scene);
  }
}

setInterval(() => document.hidden || renew(), EVERY_MS);
