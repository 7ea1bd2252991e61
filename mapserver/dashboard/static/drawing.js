// An outline drawn on the map, for a survey or a named area, and the areas that are there. While drawing is switched on, each click is a
// corner, and one on the first corner switches it off; the corners are also a text. They stay when the page is loaded again.
import { mark } from "./map/index.js";

const LAYER = "Outline that you draw";
const EXAMPLE = "write x and y in metres, as in 0, 0; 4, 0; 4, 3";
const [map, drawing] = ["map", "drawing"].map((id) => document.getElementById(id));
let corners = history.state?.corners ?? [];

function drawn() {
  const parts = ["[type=checkbox]", "[type=text]", "[data-act$=requests]", ...["back", "close", "cancel"].map((does) => `[data-do=${does}]`)];
  const [isOn, text, survey, back, close, cancel] = parts.map((part) => drawing.querySelector(part));
  function show(lacks = corners.length < 3 && "Draw at least three corners first: switch drawing on and click into the map, or write them.") {
    const isClosed = !isOn.checked && corners.length > 2;
    const side = { kind: "line", points: isClosed ? [...corners, corners[0]] : corners, tone: "accent", width: 2, words: "", hue: null };
    const ends = corners.map(([x, y], n) => mark(x, y, `corner ${n + 1}`));
    map.map.show(LAYER, corners.length > 1 ? [side, ...ends] : ends, false);
    map.classList.toggle("drawing", isOn.checked);
    map.map.map.doubleClickZoom[isOn.checked ? "disable" : "enable"]();
    for (const act of drawing.querySelectorAll("[data-act]")) act.dataset.lacks = lacks || "";
    survey.dataset.body = JSON.stringify({ corners_map_m: corners });
    history.replaceState({ corners, isOn: isOn.checked }, "");
  }
  function change(made) {
    corners = made;
    text.value = corners.map((corner) => corner.join(", ")).join("; ");
    show();
  }
  function end(made) {
    isOn.checked = false;
    change(made);
  }
  map.addEventListener("pick", ({ detail: { x, y, mark: there } }) => {
    if (!isOn.checked) return;
    if (there?.words === "corner 1" && corners.length > 2) end(corners);
    else change([...corners, [x, y].map((metres) => Number(metres.toFixed(2)))]);
  });
  text.addEventListener("input", () => {
    const written = text.value.split(";").map((corner) => corner.trim()).filter(Boolean);
    const places = written.map((corner) => corner.split(/[\s,]+/).map(Number));
    const wrong = places.findIndex((place) => place.length !== 2 || !place.every(Number.isFinite));
    if (wrong < 0) corners = places;
    show(wrong < 0 ? undefined : `"${written[wrong]}" is not a corner: ${EXAMPLE}.`);
  });
  isOn.addEventListener("change", () => show());
  drawing.firstElementChild.addEventListener("click", () => {
    isOn.checked = !drawing.open && corners.length < 3;
    show();
  });
  back.addEventListener("click", () => change(corners.slice(0, -1)));
  close.addEventListener("click", () => end(corners));
  cancel.addEventListener("click", () => end([]));
  drawing.addEventListener("acted", () => end([]));
  isOn.checked = history.state?.isOn ?? false;
  drawing.open = isOn.checked || corners.length > 0;
  change(corners);
}

// The areas are sent as a whole: as they were when the dialog opened, with one change. The server refuses it if others changed them since.
const described = ({ name, kind, lift, mask, percent, correction, reason }) => ({
  name, ...(kind && { lift: lift.trim() }), ...(mask && { mask }), ...(mask === "speed" && { percent: Number(percent) }), ...(correction && { correction: { kind: correction, reason } }),
});
const isCalled = (name) => ({ properties }) => properties.name === name;
const outlined = () => ({ type: "Polygon", coordinates: [[...corners, corners[0]]] });
const CHANGES = {
  add: (areas, _, fields) => [...areas, { type: "Feature", geometry: outlined(), properties: described(fields) }],
  change: (areas, name, fields) => areas.map((area) => (isCalled(name)(area) ? { ...area, properties: described(fields) } : area)),
  remove: (areas, name) => areas.filter((area) => !isCalled(name)(area)),
};

async function send(before, { dataset }, { name, kind, lift, mask, percent, correction, ...by }) {
  const answer = (await before).clone(); // for another try
  if (!answer.ok) return answer;
  const areas = await answer.json();
  if (dataset.name && !areas.features.some(isCalled(dataset.name)))
    return new Response(JSON.stringify({ detail: `There is no area ${dataset.name} any more: somebody else changed it.` }), { status: 412 });
  const features = CHANGES[dataset.area](areas.features, dataset.name, { name: name?.trim(), kind, lift, mask, percent, correction, reason: by.reason });
  const headers = { "If-Match": answer.headers.get("ETag"), "Content-Type": "application/geo+json" };
  const request = features.length ? { method: "PUT", headers, body: JSON.stringify({ ...areas, features }) } : { method: "DELETE", headers };
  return fetch(`${dataset.act}?${new URLSearchParams(by)}`, request);
}

document.addEventListener("asked", ({ target }) => {
  if (!target.dataset.area || target.dataset.lacks) return;
  const before = fetch(target.dataset.act, { cache: "no-store" });
  before.catch(() => {}); // it is told when it is sent
  target.send = (act, told) => send(before, act, told);
  const { kind, lift, mask, percent, correction, reason } = document.querySelector("dialog form").elements;
  if (!mask) return;
  const follow = () => {
    lift.disabled = lift.parentElement.hidden = !kind.value; // what is hidden is not checked
    percent.disabled = percent.parentElement.hidden = mask.value !== "speed";
    reason.required = Boolean(correction.value) && correction.value !== target.dataset.correction;
  };
  for (const field of [kind, mask, correction]) field.addEventListener("change", follow);
  follow();
});
if (drawing) drawn();
