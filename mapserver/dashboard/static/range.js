// A time is chosen by dragging in a chart, which says from when until when it shows, in milliseconds since 1970, and by `data-to` on which page.
const [MINUTE_MS, LEAST_PX] = [60_000, 6];
const shade = Object.assign(document.createElement("div"), { className: "dragged" }); // on the page while somebody drags
let drag;

const ends = (x) => [drag.from, x].map((px) => Math.min(drag.box.right, Math.max(drag.box.left, px))).sort((a, b) => a - b);

function end() {
  drag = undefined;
  setTimeout(() => shade.remove()); // after the click that ends it
}

addEventListener("pointerdown", ({ target, button, clientX }) => {
  const chart = button === 0 ? target.closest("[data-since]") : null;
  drag = chart ? { chart, box: chart.getBoundingClientRect(), from: clientX } : undefined;
});
addEventListener("pointermove", ({ clientX }) => {
  if (!drag || (!shade.isConnected && Math.abs(clientX - drag.from) < LEAST_PX)) return;
  const { top, height } = drag.box, [left, right] = ends(clientX);
  Object.assign(shade.style, { left: `${left}px`, width: `${right - left}px`, top: `${top}px`, height: `${height}px` });
  document.body.append(shade);
});
addEventListener("pointerup", ({ clientX }) => {
  if (drag && shade.isConnected) {
    const { left, width } = drag.box, { since, until, to = location } = drag.chart.dataset, address = new URL(to, location);
    const [first, last] = ends(clientX).map((px) => (Number(since) + ((px - left) / width) * (until - since)) / MINUTE_MS);
    for (const [name, minute] of [["since", Math.floor(first)], ["until", Math.ceil(last)]])
      address.searchParams.set(name, `${new Date(minute * MINUTE_MS).toISOString().slice(0, 16)}Z`);
    for (const name of ["older", "job"]) address.searchParams.delete(name); // what is chosen in a range is perhaps not in another one
    location.assign(address);
  }
  end();
});
addEventListener("pointercancel", end);
addEventListener("dragstart", (event) => event.target.closest?.("[data-since]") && event.preventDefault()); // its links are no things to drag
addEventListener("click", (event) => shade.isConnected && event.preventDefault(), true);
