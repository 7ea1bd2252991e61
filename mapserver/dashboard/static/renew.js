// Shows what is marked `data-renew` anew from time to time, as it would be loaded, unless somebody writes into it; and what lies on maps.
const EVERY_MS = 5000;

export async function renew() {
  const answer = await fetch(location.href).catch(() => undefined);
  if (!answer?.ok) return;
  if (answer.redirected) location.reload(); // to sign in
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
  for (const shown of document.querySelectorAll("[data-renew]")) {
    const other = fresh.getElementById(shown.id);
    if (other && !shown.contains(document.activeElement) && other.innerHTML !== shown.innerHTML) shown.replaceChildren(...other.childNodes);
  }
  for (const element of document.querySelectorAll("[data-scene]")) {
    const scene = fresh.getElementById(element.id)?.dataset.scene;
    if (!scene || scene === element.dataset.scene) continue;
    element.dataset.scene = scene;
    for (const { name, items } of JSON.parse(scene).layers) element.map?.show(name, items);
  }
}

setInterval(() => document.hidden || renew(), EVERY_MS);
