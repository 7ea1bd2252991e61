// Shows what is marked `data-renew` anew every 5 or so many seconds, as it would be loaded,
// unless somebody writes into it; and what lies on maps.
const EVERY_MS = 1000 * (document.querySelector("[data-renew]")?.dataset.renew || 5);
const shown = new Map([...document.querySelectorAll("[data-renew]")].map((part) => [part, part.innerHTML]));

export async function renew() {
  const answer = await fetch(location.href).catch(() => undefined);
  if (!answer?.ok) return;
  if (answer.redirected) location.reload(); // to sign in
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
  for (const [part, before] of shown) {
    const other = fresh.getElementById(part.id);
    if (!other || other.innerHTML === before || part.contains(document.activeElement)) continue;
    shown.set(part, other.innerHTML); // not as it stands on the page, where somebody opened a part of it
    part.replaceChildren(...other.childNodes);
  }
  for (const element of document.querySelectorAll("[data-scene]")) {
    const scene = fresh.getElementById(element.id)?.dataset.scene;
    if (!scene || scene === element.dataset.scene) continue;
    const before = JSON.parse(element.dataset.scene).layers.map(({ items }) => JSON.stringify(items));
    element.dataset.scene = scene;
    JSON.parse(scene).layers.forEach(({ name, items }, n) => JSON.stringify(items) === before[n] || element.map?.show(name, items));
  }
}

setInterval(() => document.hidden || renew(), EVERY_MS);
