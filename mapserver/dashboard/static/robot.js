// A person's word of where a robot stands.
import { mark } from "./map/index.js";

const element = document.getElementById("map");
const map = element?.map;
const place = document.getElementById("place");
const robot = document.querySelector("h1").textContent;

function choose() {
  const button = place.querySelector("[data-act]");
  const [x, y, degrees] = ["x", "y", "heading"].map((name) => place.elements[name].valueAsNumber);
  const isPlaced = Number.isFinite(x + y);
  const turn = Number.isFinite(degrees) ? (degrees * Math.PI) / 180 : null;
  const facing = turn === null ? "looking any way" : `looking at ${degrees} degrees`;
  button.dataset.lacks = isPlaced ? "" : "Click into the map, or write x and y.";
  button.dataset.explains = `${robot} will search for itself around ${x}, ${y} m, ${facing}. No other robot is changed.`;
  button.dataset.body = JSON.stringify({ x_map_m: x, y_map_m: y, heading_rad: turn });
  const chosen = mark(x, y, "chosen place", { shape: turn === null ? "cross" : "arrow", heading_rad: turn });
  map.show("Chosen place", isPlaced ? [chosen] : [], false);
}

if (place) {
  place.addEventListener("input", choose);
  element.addEventListener("pick", ({ detail: { x, y } }) => {
    [place.elements.x.value, place.elements.y.value] = [x.toFixed(2), y.toFixed(2)];
    choose();
  });
  choose();
}
