// The map of the pages that the page library draws: its element holds the map that all pages have.
import { SiteMap } from "fleetmap-map";
import { loadResource } from "../../static/utils/resources.js";

export default {
  template: "<div></div>",
  props: { scene: Object, resourcePath: String },
  async mounted() {
    await this.$nextTick(); // window.path_prefix is set by then
    await loadResource(window.path_prefix + `${this.resourcePath}/leaflet.css`);
    this.map = new SiteMap(this.$el, this.scene, { onPick: (x, y) => this.$emit("pick", { x, y }) });
  },
  unmounted() {
    this.map?.remove();
  },
  methods: {
    show(name, items, isMoving) {
      this.map?.show(name, items, isMoving); // before the map is there: the next report is soon
    },
  },
};
