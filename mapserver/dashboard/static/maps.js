// Draws each map of a page from what its element says; a click beside the marks is its event `pick`, with x and y in metres.
import { SiteMap } from "./map/index.js";

for (const element of document.querySelectorAll("[data-scene]")) {
  const onPick = (x, y) => element.dispatchEvent(new CustomEvent("pick", { detail: { x, y } }));
  element.map = new SiteMap(element, JSON.parse(element.dataset.scene), { onPick });
}
