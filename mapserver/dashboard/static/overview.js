// The Overview: the map, and beside it the robots; the server's stream keeps both up to date.
import { SiteMap } from "./map/index.js";
import { follow } from "./stream.js";
import { arrange } from "./table.js";

const NEAR_ZOOM = 5;
const { scene, now } = JSON.parse(document.getElementById("data").textContent);
const element = document.getElementById("map");
const map = scene && new SiteMap(element, scene, { fillsPage: true });
if (!map) element.replaceWith(made("p", "notice", "No map is published yet: robots cannot be shown on it."));
const line = document.getElementById("line");
const list = document.getElementById("robots");
const rows = new Map();
const shownNow = new Map();
let state = now;

function made(tag, className, text) {
  const node = document.createElement(tag);
  node.className = className;
  node.textContent = text; // robots choose their words: text, never markup
  return node;
}

// The first act is to acknowledge it.
function acts({ id, is_open }) {
  const found = document.getElementById("incident-acts").content.cloneNode(true);
  const buttons = [...found.querySelectorAll("[data-act]")];
  for (const button of buttons) button.dataset.body = JSON.stringify({ incident: id });
  if (!is_open) buttons[0]?.remove();
  return found;
}

function row({ name, to }) {
  const item = made("li", "", "");
  const link = made("a", "name", name);
  link.href = to;
  item.append(link, ...["state", "since", "about"].map((part) => made("span", part, "")), made("div", "acts", ""));
  item.addEventListener("click", ({ target }) => {
    const place = state.robots.find((robot) => robot.name === name)?.place;
    if (!target.closest("a, button") && place && map) map.map.setView([place[1], place[0]], NEAR_ZOOM);
  });
  return item;
}

function refresh(item, robot) {
  item.className = robot.tone;
  const [, now, since, about] = item.children;
  for (const [part, text] of [[now, robot.state], [since, robot.since], [about, robot.about]]) if (part.textContent !== text) part.textContent = text;
  since.title = robot.exact;
  const incident = JSON.stringify(robot.incident ?? null);
  if (item.dataset.incident === incident) return;
  item.dataset.incident = incident;
  item.lastChild.replaceChildren(...(robot.incident ? [acts(robot.incident)] : []));
}

function notice({ tone, words, to, more, incident }) {
  const box = made("p", `notice ${tone}`, `${words} `);
  box.append(Object.assign(made("a", "", more), { href: to }));
  if (incident) box.append(acts(incident));
  return box;
}

function say({ words, tone }) {
  if (line.textContent === words) return;
  line.textContent = words;
  line.className = `line ${tone}`;
}

function floor({ words, to, is_chosen }) {
  return Object.assign(made("a", is_chosen ? "chosen" : "", words), { href: to, ariaCurrent: is_chosen ? "true" : null });
}

function bars(days) {
  const most = Math.max(...days, 1e-9);
  const drawn = made("span", "bars", "");
  drawn.setAttribute("role", "img");
  drawn.setAttribute("aria-label", `failures per robot-day of the last ${days.length} days`);
  for (const day of days) drawn.append(Object.assign(document.createElement("i"), { style: day === null ? "" : `height: max(2px, ${Math.round((100 * day) / most)}%)` }));
  return drawn;
}

function keyFigure({ name, value, more, days }) {
  const box = document.createElement("div");
  box.append(made("span", "quiet", name), made("strong", "", value));
  if (days) box.append(bars(days));
  if (more) box.append(made("span", "quiet", more));
  return box;
}

function show(id, found, draw) {
  const key = JSON.stringify(found);
  if (shownNow.get(id) === key) return;
  shownNow.set(id, key);
  document.getElementById(id).replaceChildren(...found.map(draw));
}

function update() {
  say(state.line);
  show("figures", state.figures, keyFigure);
  show("notices", state.notices, notice);
  show("floors", state.floors, floor);
  const items = state.robots.map((robot) => {
    if (!rows.has(robot.name)) rows.set(robot.name, row(robot));
    refresh(rows.get(robot.name), robot);
    return rows.get(robot.name);
  });
  // What stands in its place already stays: a click or a focus is not lost to a report.
  items.forEach((item, n) => list.children[n] !== item && list.insertBefore(item, list.children[n] ?? null));
  while (list.children.length > items.length) list.lastChild.remove();
  arrange(document);
  map?.show("Robots", state.marks);
}

update();
follow(
  "now",
  (told) => {
    state = told;
    update();
  },
  () => say({ words: "The server does not answer; trying again.", tone: "bad" }),
);
