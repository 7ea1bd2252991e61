// A time is chosen by dragging in a chart, which says from when until when it shows, in milliseconds since 1970.
const [MINUTE_MS, LEAST_PX] = [60_000, 6];
const shade = Object.assign(document.createElement("div"), { className: "dragged" });
let chart, from;
let isDragged = false;

const boxOf = (x) => {
  const { left, right, top, height } = chart.getBoundingClientRect();
  const [start, end] = [from, x].map((px) => Math.min(right, Math.max(left, px))).sort((a, b) => a - b);
  return { start, end, left, top, height, width: right - left };
};

function end() {
  shade.remove();
  chart = undefined;
  setTimeout(() => (isDragged = false)); // after the click that ends it
}

addEventListener("pointerdown", ({ target, button, clientX }) => {
  [chart, from, isDragged] = [button === 0 ? target.closest("[data-since]") : undefined, clientX, false];
});
addEventListener("pointermove", ({ clientX }) => {
  if (!chart || (!isDragged && Math.abs(clientX - from) < LEAST_PX)) return;
  isDragged = true;
  const { start, end, top, height } = boxOf(clientX);
  Object.assign(shade.style, { left: `${start}px`, width: `${end - start}px`, top: `${top}px`, height: `${height}px` });
  document.body.append(shade);
});
addEventListener("pointerup", ({ clientX }) => {
  if (chart && isDragged) {
    const { since, until } = chart.dataset;
    const { start, end, left, width } = boxOf(clientX);
    const [first, last] = [start, end].map((px) => (Number(since) + ((px - left) / width) * (until - since)) / MINUTE_MS);
    const to = new URL(chart.dataset.to ?? location, location);
    for (const [name, minute] of [["since", Math.floor(first)], ["until", Math.ceil(last)]])
      to.searchParams.set(name, `${new Date(minute * MINUTE_MS).toISOString().slice(0, 16)}Z`);
    location.assign(to);
  }
  end();
});
addEventListener("pointercancel", end);
addEventListener("dragstart", (event) => event.target.closest?.("[data-since]") && event.preventDefault()); // its links are no things to drag
addEventListener("click", (event) => isDragged && event.preventDefault(), true);
