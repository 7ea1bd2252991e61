// The map of all pages: leaflet over metres (x to the right, y up), with layers and with marks that move between two reports.
import * as L from "../vendor/leaflet/leaflet.js";
import { Axes, Marks, MarkSet, Trails, words } from "./marks.js";

const POINTS_PER_NAME_PX = 7;

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
  dots(item) {
    const points = [];
    for (let n = 0; n < item.points.length; n += 2) {
      const place = [item.points[n + 1], item.points[n]];
      points.push([place, place]);
    }
    return L.polyline(points, { className: "dots", weight: 2.5, smoothFactor: 0, noClip: true, interactive: false });
  },
};

export class SiteMap {
  // element: is filled by the map; scene: label, box and layers as of map_layers.py; onPick(x, y, mark): a click, but on a mark that leads to a page.
  // fillsPage: the wheel zooms at once; else it scrolls the page until the map has the focus.
  constructor(element, scene, { onPick = () => {}, fillsPage = false } = {}) {
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
      scrollWheelZoom: fillsPage,
      renderer: L.svg({ padding: 0.5 }),
    }));
    if (!fillsPage) {
      map.on("focus", () => map.scrollWheelZoom.enable());
      map.on("blur", () => map.scrollWheelZoom.disable());
    }
    map.fitBounds(corners(scene.box), { padding: [6, 6] });
    const marks = new Marks();
    if (scene.hasAxes !== false) map.addLayer(new Axes());
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
    element.addEventListener("wheel", () => (this.follows &&= !map.scrollWheelZoom.enabled()), { passive: true });
    this.observer = new ResizeObserver(() => {
      map.invalidateSize({ pan: false });
      if (!this.touched) map.fitBounds(corners(this.box ?? scene.box), { padding: [6, 6], animate: false });
    });
    map.on("dragstart", () => (this.touched = true));
    element.addEventListener("pointerdown", () => (this.touched = true));
    this.observer.observe(element);
  }
  remove() {
    this.observer.disconnect();
    this.map.remove();
  }
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
  }
  show(name, items, isMoving = true) {
    const group = this.layers[name];
    if (!group) return; // of a version that was published while the page is open
    this.fill(group, items, isMoving);
    this.nameAreas();
    if (this.follows && !this.touched) this.grow(items);
  }
  grow(items) {
    const box = (this.box ??= [...this.scene.box]);
    const add = ([x, y]) => {
      [box[0], box[1], box[2], box[3]] = [Math.min(box[0], x - 2), Math.min(box[1], y - 2), Math.max(box[2], x + 2), Math.max(box[3], y + 2)];
    };
    for (const item of items) if (item.kind === "line") item.points.forEach(add);
    this.map.fitBounds(corners(box), { padding: [6, 6], animate: false });
  }
  nameAreas() {
    // A name is there where its area has room for it.
    this.map.eachLayer((name) => {
      if (!name.area) return;
      const [low, high] = [name.area.getSouthWest(), name.area.getNorthEast()].map((at) => this.map.latLngToLayerPoint(at));
      const hasRoom = high.x - low.x > POINTS_PER_NAME_PX * name.getContent().textContent.length && low.y - high.y > 14;
      name.getElement().style.display = hasRoom ? "" : "none";
    });
  }
}
