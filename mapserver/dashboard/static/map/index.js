// The map of all pages: leaflet over metres (x to the right, y up), with layers and with marks that move between two reports. Each is drawn
// from what its element says; a click is its event `pick`, with x and y in metres and the mark that is there, unless that leads to a page.
import * as L from "../vendor/leaflet/leaflet.js";
import { Axes, Marks, MarkSet, words } from "./marks.js";

const POINTS_PER_NAME_PX = 7;
const FIT = { padding: [6, 6], animate: false };

const corners = ([x0, y0, x1, y1]) => [[y0, x0], [y1, x1]];
const places = (points) => points.map(([x, y]) => [y, x]);
const DRAWN = {
  picture: (item) => L.imageOverlay(item.url, corners(item.box), { className: `picture ${item.tone}` }),
  square: (item) =>
    L.rectangle(corners(item.box), { className: `cell ${item.tone}`, fillOpacity: 0.06 + 0.3 * item.full, weight: 1 }),
  area: (item) => L.polygon(item.rings.map(places), { className: `area ${item.tone}`, fill: true, fillOpacity: 0.001, weight: 1.2 }),
  line(item) {
    const drawn = L.polyline(places(item.points), { className: `line ${item.tone}`, weight: item.width, smoothFactor: 0 });
    if (item.hue !== null) drawn.on("add", () => drawn.getElement().style.setProperty("stroke", `hsl(${item.hue} 75% 55% / .55)`));
    return drawn;
  },
  dots({ points }) {
    const dots = Array.from({ length: points.length / 2 }, (_, n) => Array(2).fill([points[2 * n + 1], points[2 * n]]));
    return L.polyline(dots, { className: "dots", weight: 2.5, smoothFactor: 0, noClip: true, interactive: false });
  },
};

// What people choose on a map, as map_layers.py tells marks.
export const mark = (x, y, words, more) => ({ kind: "mark", x, y, words, tone: "accent", shape: "square", name: "", address: null, heading_rad: null, ...more });

export class SiteMap {
  // element: is filled by the map; scene: label, box and layers as of map_layers.py; onPick(x, y, mark): a click, but on a mark that leads to a page.
  // fills_page of a scene: the wheel zooms at once; else it scrolls the page until the map has the focus.
  constructor(element, scene, { onPick = () => {} } = {}) {
    this.element = element;
    this.scene = scene;
    element.setAttribute("role", "group");
    element.setAttribute("aria-label", `${scene.label}; what is marked on it is listed on this page`);
    const map = (this.map = L.map(element, {
      crs: L.CRS.Simple,
      minZoom: -6,
      maxZoom: 8,
      zoomSnap: 0.25,
      zoomAnimation: false,
      fadeAnimation: false,
      attributionControl: false,
      scrollWheelZoom: scene.fills_page ?? false,
      renderer: L.svg({ padding: 0.5 }),
    }));
    if (!scene.fills_page) {
      map.on("focus", () => map.scrollWheelZoom.enable());
      map.on("blur", () => map.scrollWheelZoom.disable());
    }
    this.bounds = L.latLngBounds(corners(scene.box));
    map.fitBounds(this.bounds, FIT);
    const marks = new Marks();
    if (scene.hasAxes !== false) map.addLayer((this.axes = new Axes()));
    map.addLayer(marks);
    map.on("click", ({ containerPoint, latlng }) => {
      const mark = marks.nearest(containerPoint)?.item;
      if (!mark?.address) onPick(latlng.lng, latlng.lat, mark);
    });
    element.marks = () => marks.told(); // a canvas does not say what it shows
    this.layers = {};
    const chosen = {};
    for (const { name, items, shown } of scene.layers) {
      const group = (this.layers[name] = L.layerGroup());
      group.marks = new MarkSet(marks);
      group.marks.with(group, "isShown");
      if (shown) group.addTo(map);
      chosen[name] = group;
      this.fill(group, items, false);
      if (name === "Robots") chosen["Trails of the last minute"] = group.marks.with(L.layerGroup(), "hasTrails");
    }
    L.control.layers({}, chosen, { collapsed: true }).addTo(map);
    map.on("zoomend overlayadd overlayremove", this.nameAreas, this);
    this.nameAreas();
    element.addEventListener("wheel", () => (this.touched ||= map.scrollWheelZoom.enabled()), { passive: true });
    this.observer = new ResizeObserver(() => {
      map.invalidateSize({ pan: false });
      if (!this.touched) map.fitBounds(this.bounds, FIT);
    });
    for (const kind of ["pointerdown", "keydown"]) element.addEventListener(kind, ({ key }) => (this.touched ||= key !== "Tab"));
    this.observer.observe(element);
  }
  remove() {
    this.observer.disconnect();
    this.map.remove();
  }
  fill(group, items, isMoving) {
    group.clearLayers();
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
  }
  show(name, items, isMoving = true) {
    const group = this.layers[name];
    if (!group) return; // of a version that was published while the page is open
    this.fill(group, items, isMoving);
    if (items.some(({ kind }) => kind === "area")) this.nameAreas();
    if (this.scene.follows && !this.touched) this.grow(items);
  }
  grow(items) {
    for (const item of items)
      if (item.kind === "line") for (const [x, y] of item.points) this.bounds.extend(corners([x - 2, y - 2, x + 2, y + 2]));
    this.map.fitBounds(this.bounds, FIT);
  }
  nameAreas() {
    // A name is there where its area has room for it.
    this.map.eachLayer((name) => {
      if (!name.area) return;
      const [low, high] = [name.area.getSouthWest(), name.area.getNorthEast()].map((at) => this.map.latLngToLayerPoint(at));
      const hasRoom = high.x - low.x > POINTS_PER_NAME_PX * name.getContent().textContent.length && low.y - high.y > 14;
      name.getElement().style.display = hasRoom ? "" : "none";
    });
    this.axes?.refresh();
  }
}

for (const element of document.querySelectorAll("[data-scene]")) {
  const onPick = (x, y, mark) => element.dispatchEvent(new CustomEvent("pick", { detail: { x, y, mark } }));
  element.map = new SiteMap(element, JSON.parse(element.dataset.scene), { onPick });
}
