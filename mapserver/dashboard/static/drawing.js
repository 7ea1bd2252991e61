// Where a survey is wanted: while drawing is switched on, each click into the map is a corner of it.
const LAYER = "Survey that you draw";
const [map, drawing] = ["map", "drawing"].map((id) => document.getElementById(id));

if (drawing) {
  const [isOn, takeBack, ask] = ["input", "#take-back", "[data-act]"].map((part) => drawing.querySelector(part));
  const corners = [];
  const show = () => {
    const side = { kind: "line", points: [...corners, corners[0]], tone: "accent", width: 2, words: "", hue: null };
    const ends = corners.map(([x, y], n) => ({ kind: "mark", x, y, tone: "accent", shape: "square", words: `corner ${n + 1}`, name: "", heading_rad: null }));
    map.map.show(LAYER, corners.length > 1 ? [side, ...ends] : ends);
    ask.dataset.body = JSON.stringify({ corners_map_m: corners });
    ask.dataset.lacks = corners.length < 3 ? "Switch drawing on and click at least three corners into the map first." : "";
  };
  map.addEventListener("pick", ({ detail: { x, y } }) => isOn.checked && (corners.push([x, y]), show()));
  takeBack.addEventListener("click", () => (corners.pop(), show()));
  show();
}
