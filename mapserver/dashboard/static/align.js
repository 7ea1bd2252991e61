// Points of a floor plan and the same of the map: a click in either is half of one, in any order. They are also a text.
// What the server makes of them is told at once; it is kept by the act, with the picture.
import { SiteMap, mark } from "./map/index.js";
import { coded, refusal } from "./stream.js";

const LAYER = "Outline that you draw";
const [map, aligning] = ["map", "aligning"].map((id) => document.getElementById(id));

function begin() {
  const parts = ["[type=file]", "[type=text]", ".paper", "output", "[data-do=back]", "[data-act]"];
  const [chosen, text, paper, told, back, save] = parts.map((part) => aligning.querySelector(part));
  const to = save.dataset.act;
  let plan, asked, pins = []; // the last one may lack its half

  const isWhole = ({ plan, map }) => plan && map;
  const query = (more = {}) => new URLSearchParams([...pins.filter(isWhole).map(({ plan, map }, n) => ["pin", `${n + 1}=${plan}:${map}`]), ...Object.entries(more)]);
  const isOpen = () => aligning.open && !map.classList.contains("drawing");
  const marks = (side, turn) =>
    pins.flatMap(({ [side]: place }, n) => (place ? [mark(place[0], turn * place[1], `point ${n + 1}`, { name: `${n + 1}` })] : []));
  function show() {
    map.map.show(LAYER, marks("map", 1), false);
    plan?.show("Points", marks("plan", -1), false);
    save.dataset.lacks = pins.filter(isWhole).length < 2 ? "Give at least two points first: click a point in the plan and the same in the map, or write them." : "";
    estimate();
  }
  // Which points fit how well, while they are given.
  async function estimate() {
    const half = pins.find((pin) => !isWhole(pin));
    told.textContent = half ? `Now the same point in the ${half.plan ? "map" : "plan"}.` : "";
    if (pins.filter(isWhole).length < 2) return;
    const now = (asked = query().toString());
    const answer = await fetch(`${to}/estimate?${now}`).catch(() => undefined);
    const found = answer?.ok ? await answer.json() : await refusal(answer);
    if (asked !== now) return;
    if (!answer?.ok) return told.replaceChildren(...coded(found));
    const left = Object.entries(found.off_m).map(([name, off]) => `${name}: ${off.toFixed(2)} m`).join(", ");
    const checked = found.is_checked ? "" : " Two points fit always: a third would show a mistake.";
    told.textContent = `${found.metres_per_unit.toPrecision(3)} m for each pixel. Left at the points: ${left}.${checked} ${told.textContent}`;
  }
  function pick(side, place) {
    const half = pins.find((pin) => !isWhole(pin));
    if (half) half[side] = place;
    else pins.push({ [side]: place });
    write();
  }
  function write() {
    text.value = pins.filter(isWhole).map(({ plan, map }) => `${plan.join(", ")}: ${map.join(", ")}`).join("; ");
    show();
  }
  map.addEventListener("pick", ({ detail: { x, y } }) => isOpen() && pick("map", [x, y].map((metres) => Number(metres.toFixed(2)))));
  back.addEventListener("click", () => {
    pins.pop();
    write();
  });
  text.addEventListener("input", () => {
    const written = text.value.split(";").filter((pin) => pin.trim()).map((pin) => pin.split(":").map((side) => side.split(",").map(Number)));
    const isRight = written.every((pin) => pin.length === 2 && pin.every((side) => side.length === 2 && side.every(Number.isFinite)));
    pins = isRight ? written.map(([plan, map]) => ({ plan, map })) : [];
    show();
    if (!isRight) told.textContent = "Write pixels and metres as in 120, 2310: 0.4, -1.2; 900, 2310: 39, -1.2";
  });
  chosen.addEventListener("change", () => {
    const reader = new FileReader(), image = new Image();
    reader.onload = () => (image.src = reader.result);
    image.onerror = () => (told.textContent = "This browser cannot show the picture; write the points, or choose a PNG or JPEG.");
    image.onload = () => {
      const box = [0, -image.naturalHeight, image.naturalWidth, 0];
      plan?.remove();
      const sheet = Object.assign(document.createElement("div"), { className: "site-map", tabIndex: 0 });
      paper.replaceChildren(sheet);
      const layers = [{ name: "Plan", items: [{ kind: "picture", url: image.src, box, tone: "paper" }], shown: true }, { name: "Points", items: [], shown: true }];
      plan = new SiteMap(sheet, { label: "Floor plan", box, layers, follows: false, hasAxes: false }, { onPick: (x, y) => pick("plan", [x, -y].map(Math.round)) });
      show();
    };
    if (chosen.files[0]) reader.readAsDataURL(chosen.files[0]);
  });
  save.addEventListener("asked", () => {
    save.send = (_, by) => {
      const file = chosen.files[0];
      return fetch(`${to}?${query({ ...(file && { plan: file.name }), ...by })}`, { method: "PUT", body: file, headers: { "Content-Type": "application/octet-stream" } });
    };
  });
  for (const forget of aligning.querySelectorAll("[data-forget]"))
    forget.addEventListener("asked", () => (forget.send = (_, by) => fetch(`${to}?${new URLSearchParams(by)}`, { method: "DELETE" })));
  aligning.addEventListener("toggle", () => (aligning.open ? show() : map.map.show(LAYER, [], false)));
}

if (aligning) begin();
