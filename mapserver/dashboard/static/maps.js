// Draws each map of a page from what its element says; a click is its event `pick`, with x and y in metres and the mark that is there,
// unless that leads to a page.
import { SiteMap } from "./map/index.js";

for (const element of document.querySelectorAll("[data-scene]")) {
  const onPick = (x, y, mark) => element.dispatchEvent(new CustomEvent("pick", { detail: { x, y, mark } }));
  element.map = new SiteMap(element, JSON.parse(element.dataset.scene), { onPick });
}
