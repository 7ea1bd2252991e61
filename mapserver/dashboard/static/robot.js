// The page of a robot: what it is now, from second to second, and a person's word of where it stands.
import "./maps.js";
import "./renew.js";
import { follow } from "./stream.js";

const element = document.getElementById("map");
const map = element?.map;
const line = document.getElementById("line");
const advice = document.getElementById("advice");
const facts = document.getElementById("facts");
const place = document.getElementById("place");
const robot = document.querySelector("h1").textContent;
const made = (tag, text) => Object.assign(document.createElement(tag), { textContent: text }); // robots choose their words: never markup

function say({ tone, words, exact, advice: what = "" }) {
  Object.assign(line, { className: `notice ${tone}`, title: exact });
  if (line.textContent !== words) line.textContent = words;
  advice.textContent = what;
}

function show({ line: told, facts: known, marks }) {
  say(told);
  facts.replaceChildren(...known.flatMap(([name, value]) => [made("dt", name), made("dd", value)]));
  map?.show("Robots", marks);
  for (const { x, y } of map && !map.touched ? marks : []) map.map.panInside([y, x], { padding: [40, 40] });
}

function choose() {
  const button = place.querySelector("[data-act]");
  const [x, y, degrees] = ["x", "y", "heading"].map((name) => place.elements[name].valueAsNumber);
  const isPlaced = Number.isFinite(x + y);
  const turn = Number.isFinite(degrees) ? (degrees * Math.PI) / 180 : null;
  const facing = turn === null ? "looking any way" : `looking at ${degrees} degrees`;
  button.dataset.lacks = isPlaced ? "" : "Click into the map, or write x and y.";
  button.dataset.explains = `${robot} will search for itself around ${x}, ${y} m, ${facing}. No other robot is changed.`;
  button.dataset.body = JSON.stringify({ x_map_m: x, y_map_m: y, heading_rad: turn });
  const mark = { kind: "mark", x, y, tone: "accent", shape: turn === null ? "cross" : "arrow", words: "chosen place", address: null, name: "", heading_rad: turn };
  map.show("Chosen place", isPlaced ? [mark] : [], false);
}

if (place) {
  place.addEventListener("input", choose);
  element.addEventListener("pick", ({ detail: { x, y } }) => {
    [place.elements.x.value, place.elements.y.value] = [x.toFixed(2), y.toFixed(2)];
    choose();
  });
  choose();
}
show(JSON.parse(document.getElementById("now").textContent));
follow(`${robot}/now`, show, () => say({ words: "The server does not answer; trying again.", tone: "bad", exact: "" }));
