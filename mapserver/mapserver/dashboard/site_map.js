// The map of all pages: leaflet over metres (x to the right, y up), with layers and with marks that move between two reports.
import { leaflet as L } from "nicegui-leaflet";
import { loadResource } from "../../static/utils/resources.js";

const SHAPES = {
  circle: "M-5 0a5 5 0 1 0 10 0a5 5 0 1 0-10 0Z",
  square: "M-5-5H5V5H-5Z",
  triangle: "M0-6.5L6 5H-6Z",
  cross: "M-5-5L5 5M-5 5L5-5",
  arrow: "M-9 0H7M2-4.5L8 0L2 4.5",
};
const MOVE_MS = 1000; // robots report every second
const FRAME_MS = 30;
const JUMP_M = 6; // who goes further within a second did not drive there
const NAMED_PX_PER_M = 16;
const FEW = 12;
const TRAIL = 60;
const POINTS_PER_NAME_PX = 7;

const svg = (name, attributes = {}) => {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const key in attributes) node.setAttribute(key, attributes[key]);
  return node;
};
const words = (text) => {
  const node = document.createElement("span"); // robots and people choose their words: text, never markup
  node.textContent = text;
  return node;
};

// All marks of a layer in one SVG, whose units are leaflet's pixels; nothing is drawn while no mark moves.
const Marks = L.Layer.extend({
  initialize() {
    this.marks = new Map();
    this.hasTrails = false;
  },
  onAdd(map) {
    this.map = map;
    this.root = svg("svg", { class: "marks" });
    this.trails = this.root.appendChild(svg("path", { class: "trails" }));
    map.getPane("markerPane").appendChild(this.root);
    map.on("zoomend viewreset", this.redraw, this);
    for (const mark of this.marks.values()) this.root.appendChild(mark.node);
    this.redraw();
  },
  onRemove(map) {
    map.off("zoomend viewreset", this.redraw, this);
    this.root.remove();
    this.root = undefined;
  },
  show(items, isMoving) {
    const seen = new Set();
    const still = !isMoving || matchMedia("(prefers-reduced-motion: reduce)").matches;
    items.forEach((item, n) => {
      const key = item.name || `${n}`;
      seen.add(key);
      let mark = this.marks.get(key);
      if (!mark || mark.item.address !== item.address) {
        mark?.node.remove();
        mark = { x: item.x, y: item.y, path: [] };
        mark.node = svg(item.address ? "a" : "g", item.address ? { href: item.address } : {});
        mark.title = mark.node.appendChild(svg("title"));
        mark.nose = mark.node.appendChild(svg("path", { class: "nose", d: "M5 0H13" }));
        mark.shape = mark.node.appendChild(svg("path", { class: "shape" }));
        mark.text = mark.node.appendChild(svg("text", { x: 9, y: -7 }));
        mark.node.addEventListener("click", (event) => this.map.dragging.moved() && event.preventDefault());
        this.marks.set(key, mark);
        this.root?.appendChild(mark.node);
      }
      this.dress(mark, item);
      const far = Math.hypot(item.x - mark.x, item.y - mark.y) > JUMP_M;
      mark.from = still || far ? undefined : { x: mark.x, y: mark.y, since: performance.now() };
      if (!mark.from) [mark.x, mark.y] = [item.x, item.y];
      mark.path.push([item.x, item.y]);
      if (mark.path.length > TRAIL) mark.path.shift();
    });
    for (const [key, mark] of this.marks) if (!seen.has(key)) mark.node.remove(), this.marks.delete(key);
    this.redraw();
    if (!this.frame && !still) this.frame = requestAnimationFrame((now) => this.step(now));
  },
  dress(mark, item) {
    const css = `mark ${item.tone} ${item.shape}`;
    if (mark.css !== css) mark.node.setAttribute("class", (mark.css = css));
    if (mark.item?.shape !== item.shape) mark.shape.setAttribute("d", SHAPES[item.shape]);
    if (mark.item?.words !== item.words) {
      mark.title.textContent = item.words;
      if (item.address) mark.node.setAttribute("aria-label", item.words);
    }
    if (mark.item?.name !== item.name) mark.text.textContent = item.name;
    const turn = item.heading_rad === null ? "" : `rotate(${((-item.heading_rad * 180) / Math.PI).toFixed(1)})`;
    if (mark.turn !== turn) {
      mark.turn = turn;
      mark.nose.setAttribute("transform", turn);
      mark.nose.style.display = turn && item.shape !== "arrow" ? "" : "none";
      if (item.shape === "arrow") mark.shape.setAttribute("transform", turn);
    }
    mark.node.dataset.name = item.name;
    mark.node.dataset.at = `${item.x.toFixed(2)} ${item.y.toFixed(2)}`;
    mark.item = item;
  },
  step(now) {
    this.frame = undefined;
    let isMoving = false;
    if (this.root && now - (this.drawn ?? 0) >= FRAME_MS) {
      this.drawn = now;
      for (const mark of this.marks.values()) {
        if (!mark.from) continue;
        const share = Math.min(1, (now - mark.from.since) / MOVE_MS);
        mark.x = mark.from.x + share * (mark.item.x - mark.from.x);
        mark.y = mark.from.y + share * (mark.item.y - mark.from.y);
        if (share === 1) mark.from = undefined;
        this.put(mark);
      }
    }
    for (const mark of this.marks.values()) isMoving ||= mark.from !== undefined;
    if (this.root && isMoving) this.frame = requestAnimationFrame((then) => this.step(then));
  },
  put(mark) {
    const [x, y] = [mark.x * this.scale - this.origin.x, -mark.y * this.scale - this.origin.y];
    mark.node.setAttribute("transform", `translate(${x.toFixed(1)} ${y.toFixed(1)})`);
  },
  redraw() {
    if (!this.root) return;
    this.scale = this.map.options.crs.scale(this.map.getZoom());
    this.origin = this.map.getPixelOrigin();
    for (const mark of this.marks.values()) this.put(mark);
    this.root.classList.toggle("all-names", this.scale >= NAMED_PX_PER_M || this.marks.size <= FEW);
    const way = ([x, y]) => `${(x * this.scale - this.origin.x).toFixed(1)} ${(-y * this.scale - this.origin.y).toFixed(1)}`;
    const drawn = this.hasTrails ? [...this.marks.values()].map((mark) => "M" + mark.path.map(way).join("L")) : [];
    this.trails.setAttribute("d", drawn.join(""));
  },
});

const Trails = L.Layer.extend({
  initialize(marks) {
    this.marks = marks;
  },
  onAdd() {
    this.marks.hasTrails = true;
    this.marks.redraw();
  },
  onRemove() {
    this.marks.hasTrails = false;
    this.marks.redraw();
  },
});

const corners = ([x0, y0, x1, y1]) => [[y0, x0], [y1, x1]];
const places = (points) => points.map(([x, y]) => [y, x]);
const DRAWN = {
  picture: (item) => L.imageOverlay(item.url, corners(item.box), { className: `picture ${item.tone}` }),
  square: (item) =>
    L.rectangle(corners(item.box), { className: `cell ${item.tone}`, fillOpacity: 0.06 + 0.3 * item.full, weight: 1 }),
  area: (item) => L.polygon(item.rings.map(places), { className: "area", fill: true, fillOpacity: 0.001, weight: 1.2 }),
  line(item) {
    const drawn = L.polyline(places(item.points), { className: `line ${item.tone}`, weight: item.width, smoothFactor: 0 });
    if (item.hue !== null) drawn.on("add", () => drawn.getElement().style.setProperty("stroke", `hsl(${item.hue} 75% 55% / .55)`));
    return drawn;
  },
  dots(item) {
    const points = [];
    for (let n = 0; n < item.points.length; n += 2) {
      const place = [item.points[n + 1], item.points[n]];
      points.push([place, place]);
    }
    return L.polyline(points, { className: "dots", weight: 2.5, smoothFactor: 0, noClip: true, interactive: false });
  },
};

export default {
  template: "<div></div>",
  props: { scene: Object, resourcePath: String },
  async mounted() {
    await this.$nextTick(); // window.path_prefix is set by then
    await loadResource(window.path_prefix + `${this.resourcePath}/leaflet/leaflet.css`);
    const scene = this.scene;
    this.$el.setAttribute("role", "group");
    this.$el.setAttribute("aria-label", scene.label);
    const map = (this.map = L.map(this.$el, {
      crs: L.CRS.Simple,
      minZoom: -6,
      maxZoom: 8,
      zoomSnap: 0.25,
      zoomAnimation: false,
      fadeAnimation: false,
      attributionControl: false,
      scrollWheelZoom: false,
      renderer: L.svg({ padding: 0.5 }),
    }));
    map.on("focus", () => map.scrollWheelZoom.enable()); // until then the wheel scrolls the page
    map.on("blur", () => map.scrollWheelZoom.disable());
    map.fitBounds(corners(scene.box), { padding: [6, 6] });
    L.control.scale({ imperial: false, position: "bottomleft" }).addTo(map);
    this.layers = {};
    const chosen = {};
    for (const { name, items, shown } of scene.layers) {
      const group = (this.layers[name] = L.layerGroup());
      group.marks = new Marks();
      group.addLayer(group.marks);
      if (shown) group.addTo(map);
      chosen[name] = group;
      this.fill(group, items, false);
      if (name === "Robots") chosen["Trails of the last minute"] = new Trails(group.marks);
    }
    L.control.layers({}, chosen, { collapsed: true }).addTo(map);
    map.on("zoomend overlayadd", this.nameAreas, this);
    this.nameAreas();
    this.follows = scene.follows;
    map.on("dragstart", () => (this.follows = false));
    this.$el.addEventListener("wheel", () => (this.follows &&= !map.scrollWheelZoom.enabled()), { passive: true });
    this.observer = new ResizeObserver(() => {
      map.invalidateSize({ pan: false });
      if (!this.touched) map.fitBounds(corners(this.box ?? scene.box), { padding: [6, 6], animate: false });
    });
    map.on("dragstart", () => (this.touched = true));
    this.$el.addEventListener("pointerdown", () => (this.touched = true));
    this.observer.observe(this.$el);
  },
  unmounted() {
    this.observer?.disconnect();
    this.map?.remove();
  },
  methods: {
    fill(group, items, isMoving) {
      for (const layer of group.getLayers()) if (layer !== group.marks) group.removeLayer(layer);
      for (const item of items) {
        if (item.kind === "mark") continue;
        const drawn = DRAWN[item.kind](item);
        group.addLayer(drawn);
        if (item.kind === "area") {
          const name = L.tooltip({ permanent: true, direction: "right", offset: [-4, 10], className: "area-name" });
          name.area = drawn.getBounds();
          group.addLayer(name.setLatLng(name.area.getNorthWest()).setContent(words(item.words)));
        } else if (item.words) drawn.bindTooltip(words(item.words), { sticky: true });
      }
      group.marks.show(items.filter((item) => item.kind === "mark"), isMoving);
    },
    show(name, items) {
      const group = this.layers?.[name];
      if (!group) return; // the map is not there yet: the next report is soon
      this.fill(group, items, true);
      this.nameAreas();
      if (this.follows && !this.touched) this.grow(items);
    },
    grow(items) {
      const box = (this.box ??= [...this.scene.box]);
      const add = ([x, y]) => {
        [box[0], box[1], box[2], box[3]] = [Math.min(box[0], x - 2), Math.min(box[1], y - 2), Math.max(box[2], x + 2), Math.max(box[3], y + 2)];
      };
      for (const item of items) if (item.kind === "line") item.points.forEach(add);
      this.map.fitBounds(corners(box), { padding: [6, 6], animate: false });
    },
    nameAreas() {
      // A name is there where its area has room for it.
      this.map.eachLayer((name) => {
        if (!name.area) return;
        const [low, high] = [name.area.getSouthWest(), name.area.getNorthEast()].map((at) => this.map.latLngToLayerPoint(at));
        const hasRoom = high.x - low.x > POINTS_PER_NAME_PX * name.getContent().textContent.length && low.y - high.y > 14;
        name.getElement().style.display = hasRoom ? "" : "none";
      });
    },
  },
};
