// What maps paint on canvases: axes, and the marks of all layers. Hundreds of marks that move cost a browser less than as many elements.
import * as L from "../vendor/leaflet/leaflet.js";

const SHAPES = {
  circle: new Path2D("M-5 0a5 5 0 1 0 10 0a5 5 0 1 0-10 0Z"),
  square: new Path2D("M-5-5H5V5H-5Z"),
  triangle: new Path2D("M0-6.5L6 5H-6Z"),
  cross: new Path2D("M-5-5L5 5M-5 5L5-5"),
  arrow: new Path2D("M-9 0H7M2-4.5L8 0L2 4.5"),
};
const NOSE = new Path2D("M5 0H13");
const LINES = new Set(["cross", "arrow"]);
const FONT = '12px system-ui, "Segoe UI", "DejaVu Sans", sans-serif';
const MOVE_MS = 1000; // robots report every second
const FRAME_MS = 30;
const JUMP_M = 6; // who goes further within a second did not drive there
const NAMED_PX_PER_M = 16;
const FEW = 12;
const TRAIL = 60;
const SIDES = [[false, -7], [false, 16], [true, -7], [true, 16]]; // of a mark, for its name: left of it, and where its line stands
const REACH_PX = 12; // of the pointer
const TICK_PX = 80;
const ZOOM_BUTTONS_PX = 84;

export const words = (text) => {
  const node = document.createElement("span"); // robots and people choose their words: text, never markup
  node.textContent = text;
  return node;
};

// A canvas over the whole map, painted anew when the map moves or what it shows changes. One element, however much is drawn.
const Painted = L.Layer.extend({
  onAdd(map) {
    this.map = map;
    this.canvas = map.getPane(this.pane).appendChild(document.createElement("canvas"));
    this.canvas.className = "painted";
    this.canvas.setAttribute("aria-hidden", "true");
    map.on("move zoomend viewreset resize", this.refresh, this);
    this.look = new MutationObserver(() => this.refresh());
    this.look.observe(document.body, { attributeFilter: ["class"] });
    this.refresh();
  },
  onRemove(map) {
    map.off("move zoomend viewreset resize", this.refresh, this);
    this.look.disconnect();
    cancelAnimationFrame(this.frame);
    this.canvas.remove();
    this.canvas = undefined;
  },
  refresh() {
    this.isStale = true;
    this.ask();
  },
  ask() {
    if (this.canvas) this.frame ??= requestAnimationFrame((now) => this.step(now));
  },
  step() {
    this.frame = undefined;
    this.paint();
  },
  paint() {
    const size = this.map.getSize();
    const [width, height] = [size.x, size.y].map((px) => Math.round(px * devicePixelRatio));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      Object.assign(this.canvas, { width, height });
      Object.assign(this.canvas.style, { width: `${size.x}px`, height: `${size.y}px` });
    }
    if (this.isStale) {
      L.DomUtil.setPosition(this.canvas, this.map.containerPointToLayerPoint([0, 0]));
      this.scale = this.map.options.crs.scale(this.map.getZoom());
      this.origin = this.map.layerPointToContainerPoint(L.point(0, 0).subtract(this.map.getPixelOrigin()));
      const { style } = this.canvas;
      const read = (tone) => ((style.color = `var(--${tone})`), [tone, getComputedStyle(this.canvas).color]);
      this.tones = Object.fromEntries(["ground", "ink", "edge", "quiet", "good", "warn", "bad", "accent"].map(read));
    }
    const pen = this.canvas.getContext("2d");
    pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    pen.clearRect(0, 0, size.x, size.y);
    pen.font = FONT;
    pen.lineJoin = "round";
    this.draw(pen, size);
    this.isStale = false;
  },
  at(x, y) {
    return [this.origin.x + x * this.scale, this.origin.y - y * this.scale];
  },
  corner() {
    const container = this.map.getContainer(), box = container.getBoundingClientRect();
    return [box.left + container.clientLeft, box.top + container.clientTop];
  },
  areaNames() {
    const [left, top] = this.corner();
    const boxes = [...this.map.getPane("tooltipPane").querySelectorAll(".area-name")].map((name) => name.getBoundingClientRect());
    return boxes.filter((box) => box.width > 0).map((box) => [box.left - left, box.top - top, box.right - left, box.bottom - top]);
  },
  write(pen, text, x, y) {
    pen.lineWidth = 3;
    pen.strokeStyle = this.tones.ground;
    pen.strokeText(text, x, y);
    pen.fillText(text, x, y);
  },
});

const overlaps = (box, other) => other[0] <= box[2] && box[0] <= other[2] && other[1] <= box[3] && box[1] <= other[3];

// Metres along the lower and the left edge; names of areas are there before figures.
export const Axes = Painted.extend({
  pane: "overlayPane",
  draw(pen, size) {
    const least = TICK_PX / this.scale;
    const power = 10 ** Math.floor(Math.log10(least));
    const step = power * [1, 2, 5, 10].find((digit) => digit * power >= least);
    const digits = Math.max(0, -Math.floor(Math.log10(step)));
    const [x, y] = [-this.origin.x, this.origin.y - size.y].map((px) => Math.ceil((px + 30) / this.scale / step));
    pen.strokeStyle = this.tones.quiet;
    pen.lineWidth = 1;
    pen.beginPath();
    const names = [], taken = this.areaNames();
    for (let n = x, px; (px = this.at(n * step, 0)[0]) < size.x - 20; n++) {
      pen.moveTo(px, size.y), pen.lineTo(px, size.y - 7);
      names.push([(n * step).toFixed(digits), px, size.y - 10, "center"]);
    }
    for (let n = y, px; (px = this.at(0, n * step)[1]) > ZOOM_BUTTONS_PX + 22; n++) {
      pen.moveTo(0, px), pen.lineTo(7, px);
      names.push([(n * step).toFixed(digits), 10, px + 4, "left"]);
    }
    pen.stroke();
    names.push(["x (m)", size.x - 6, size.y - 24, "right"], ["y (m)", 10, ZOOM_BUTTONS_PX + 8, "left"]);
    pen.fillStyle = this.tones.quiet;
    for (const [text, px, py, align] of names) {
      const width = pen.measureText(text).width, left = px - { left: 0, center: width / 2, right: width }[align];
      pen.textAlign = align;
      if (!taken.some((name) => overlaps([left, py - 12, left + width, py + 3], name))) this.write(pen, text, px, py);
    }
  },
});

// The marks of all layers that are shown; nothing is painted while no mark moves.
export const Marks = Painted.extend({
  pane: "markerPane",
  initialize() {
    this.sets = [];
    this.named = [];
  },
  onAdd(map) {
    Painted.prototype.onAdd.call(this, map);
    this.tip = L.tooltip({ direction: "top", offset: [0, -8] });
    map.on("mousemove", this.point, this);
    map.on("mouseout", () => this.point());
    map.on("click", (event) => this.open(event, event.originalEvent.ctrlKey || event.originalEvent.metaKey));
    map.getContainer().addEventListener("auxclick", (event) => {
      if (event.button === 1) this.open({ containerPoint: map.mouseEventToContainerPoint(event) }, true);
    });
  },
  *shown() {
    for (const set of this.sets) if (set.isShown) yield* set.marks.values();
  },
  step(now) {
    this.frame = undefined;
    let isMoving = false;
    if (this.isStale || now - (this.painted ?? 0) >= FRAME_MS) {
      this.painted = now;
      for (const mark of this.shown()) {
        if (!mark.from) continue;
        const share = Math.min(1, Math.max(0, now - mark.from.since) / MOVE_MS);
        mark.x = mark.from.x + share * (mark.item.x - mark.from.x);
        mark.y = mark.from.y + share * (mark.item.y - mark.from.y);
        if (share === 1) mark.from = undefined;
      }
      this.paint();
    }
    for (const mark of this.shown()) isMoving ||= mark.from !== undefined;
    if (isMoving) this.ask();
  },
  draw(pen, size) {
    if (this.isStale) this.choose(pen);
    for (const set of this.sets) if (set.isShown && set.hasTrails) this.drawTrails(pen, set);
    for (const mark of this.shown()) {
      const [x, y] = this.at(mark.x, mark.y);
      if (x > -20 && y > -20 && x < size.x + 20 && y < size.y + 20) this.drawMark(pen, mark.item, x, y);
    }
    pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    pen.fillStyle = this.tones.ink;
    for (const mark of this.named) {
      const [x, y] = this.at(mark.x, mark.y);
      const [left, base] = mark.side;
      this.write(pen, mark.item.name, x + (left ? -9 - mark.width : 9), y + base);
    }
  },
  drawMark(pen, { tone, shape, heading_rad: heading }, x, y) {
    pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, devicePixelRatio * x, devicePixelRatio * y);
    const colour = this.tones[tone] ?? this.tones.quiet;
    pen.strokeStyle = colour;
    pen.lineWidth = 2.5;
    if (LINES.has(shape)) {
      if (shape === "arrow") pen.rotate(-(heading ?? 0));
      pen.stroke(SHAPES[shape]);
      return;
    }
    if (heading !== null) {
      pen.rotate(-heading);
      pen.stroke(NOSE);
      pen.rotate(heading);
    }
    pen.fillStyle = tone === "quiet" ? this.tones.ground : colour;
    pen.strokeStyle = tone === "quiet" ? colour : this.tones.ground;
    pen.lineWidth = 1.5;
    pen.fill(SHAPES[shape]);
    pen.stroke(SHAPES[shape]);
  },
  drawTrails(pen, set) {
    pen.strokeStyle = this.tones.accent;
    pen.lineWidth = 1.5;
    pen.globalAlpha = 0.6;
    pen.beginPath();
    for (const mark of set.marks.values())
      mark.path.forEach(([x, y], n) => (n ? pen.lineTo(...this.at(x, y)) : pen.moveTo(...this.at(x, y))));
    pen.stroke();
    pen.globalAlpha = 1;
  },
  choose(pen) {
    // Names that have room where marks go, those in trouble first; all others where few marks are or the map is near. They keep off the
    // names of areas, but for trouble; a name stays on its side of the mark as long as it can.
    const marks = [...this.shown()].filter((mark) => mark.item.name);
    const [troubled, others] = [[], []];
    for (const mark of marks) (["bad", "warn"].includes(mark.item.tone) ? troubled : others).push(mark);
    const isNear = this.scale >= NAMED_PX_PER_M || marks.length <= FEW;
    const taken = this.areaNames();
    const place = (mark, obstacles) => {
      mark.width ??= pen.measureText(mark.item.name).width;
      for (const side of mark.side ? [mark.side, ...SIDES] : SIDES) {
        const box = this.nameBox(mark, side);
        if (obstacles.some((other) => overlaps(box, other))) continue;
        mark.side = side;
        taken.push(box);
        return true;
      }
      return false;
    };
    const areas = taken.length;
    this.named = [
      ...troubled.filter((mark) => place(mark, taken) || place(mark, taken.slice(areas))),
      ...(isNear ? others : []).filter((mark) => place(mark, taken)),
    ];
  },
  nameBox(mark, [left, base]) {
    const [x, y] = this.at(mark.item.x, mark.item.y);
    const [from, to] = left ? [x - 12 - mark.width, x - 6] : [x + 6, x + 12 + mark.width];
    return [from, y + base - 13, to, y + base + 4];
  },
  nearest(point) {
    let best, reach = REACH_PX;
    for (const mark of this.shown()) {
      const [x, y] = this.at(mark.x, mark.y);
      const away = Math.hypot(x - point.x, y - point.y);
      if (away <= reach) [best, reach] = [mark, away];
    }
    return best;
  },
  point(event) {
    const mark = this.scale && event && this.nearest(event.containerPoint);
    this.map.getContainer().classList.toggle("on-link", Boolean(mark?.item.address));
    if (mark) this.tip.setContent(words(mark.item.words)).setLatLng([mark.y, mark.x]).openOn(this.map);
    else this.tip.close();
  },
  open(event, isApart) {
    const address = this.nearest(event.containerPoint)?.item.address;
    if (address) isApart ? window.open(address, "_blank", "noopener") : location.assign(address);
  },
  told() {
    const [left, top] = this.corner();
    return [...this.shown()].map((mark) => {
      const [x, y] = this.at(mark.x, mark.y);
      const nameBox = this.named.includes(mark) ? this.nameBox(mark, mark.side).map((px, n) => px + (n % 2 ? top : left)) : null;
      return { ...mark.item, nameBox, page: [left + x, top + y] };
    });
  },
});

// The marks of one layer.
export class MarkSet {
  constructor(painter) {
    this.painter = painter;
    this.marks = new Map();
    painter.sets.push(this);
  }
  // Shows what `name` says, marks or trails, while a layer is on the map.
  with(layer, name) {
    return layer.on("add remove", ({ type }) => {
      this[name] = type === "add";
      this.painter.refresh();
    });
  }
  show(items, isMoving) {
    const still = !isMoving || matchMedia("(prefers-reduced-motion: reduce)").matches;
    const before = this.marks;
    this.marks = new Map();
    items.forEach((item, n) => {
      const key = item.name || `${n}`;
      const mark = before.get(key) ?? { x: item.x, y: item.y, path: [] };
      mark.item = item;
      const far = Math.hypot(item.x - mark.x, item.y - mark.y) > JUMP_M;
      const moves = !still && !far && (item.x !== mark.x || item.y !== mark.y);
      mark.from = moves ? { x: mark.x, y: mark.y, since: performance.now() } : undefined;
      if (!moves) [mark.x, mark.y] = [item.x, item.y];
      if (far) mark.path = []; // nobody saw how it came here
      mark.path.push([item.x, item.y]);
      if (mark.path.length > TRAIL) mark.path.shift();
      this.marks.set(key, mark);
    });
    this.painter.refresh();
  }
}
