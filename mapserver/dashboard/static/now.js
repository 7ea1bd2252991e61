// What changes from second to second, as the server's stream tells it: parts of the page, and the robots on its map.
import "./map/index.js";
import { renewParts } from "./morph.js";
import { follow } from "./stream.js";

const NEAR_ZOOM = 5;
const map = document.getElementById("map")?.map;

let told;

function take(news) {
  told = news;
  if (document.querySelector("dialog[open]")) return; // its button says what is acted on: it must not become another one
  const { html, marks } = news;
  const fresh = new DOMParser().parseFromString(html, "text/html");
  renewParts(fresh, [...fresh.body.children].map(({ id }) => document.getElementById(id)));
  map?.show("Robots", marks);
  if (marks.length === 1 && map && !map.touched) map.map.panInside([marks[0].y, marks[0].x], { padding: [40, 40] });
}

document.getElementById("robots")?.addEventListener("click", ({ target }) => {
  const place = target.closest("a, button") ? undefined : target.closest("li").dataset.place;
  if (place) map?.map.setView(JSON.parse(place), NEAR_ZOOM);
});
document.addEventListener("close", () => told && take(told), true);
follow(document.querySelector("[data-stream]").dataset.stream, take);
