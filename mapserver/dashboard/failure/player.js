// The seconds around a failure, to be stepped through. Words of robots are text here, never markup.
export default {
  template: `
    <div class="player" @pointerenter.once="fetchAll" @focusin.once="fetchAll">
      <figure v-if="picture">
        <img :src="picture.url" :alt="'Left camera image of ' + picture.clock">
        <figcaption>Left camera image of {{ picture.clock }}</figcaption>
      </figure>
      <p><strong :class="now.tone">{{ now.words }}</strong> at {{ now.clock }}, {{ now.since }}</p>
      <div class="timeline" aria-hidden="true">
        <i v-for="part in parts" :class="part.tone" :style="{ left: part.left + '%', width: part.width + '%' }"></i>
      </div>
      <label>Moment
        <input type="range" min="0" :max="scene.instants.length - 1" v-model.number="at" :aria-valuetext="now.clock + ', ' + now.since + ': ' + now.words">
      </label>
      <p class="ends quiet"><span>{{ first.clock }}</span><span>{{ last.clock }}</span></p>
    </div>`,
  props: { scene: Object },
  data() {
    return { at: this.scene.begin };
  },
  computed: {
    first() {
      return this.scene.instants[0];
    },
    last() {
      return this.scene.instants.at(-1);
    },
    now() {
      return this.scene.instants[this.at];
    },
    picture() {
      return this.scene.pictures[Math.max(0, this.now.picture)];
    },
    parts() {
      const found = [];
      this.scene.instants.forEach(({ tone }, n) => {
        if (found.at(-1)?.tone !== tone) found.push({ tone, first: n });
        found.at(-1).end = n + 1;
      });
      const share = 100 / this.scene.instants.length;
      return found.map(({ tone, first, end }) => ({ tone, left: share * first, width: share * (end - first) }));
    },
  },
  watch: {
    at() {
      const { x, y, tone, words, clock, heading_rad } = this.now;
      const mark = { kind: "mark", shape: "circle", address: null, name: "", words: `${clock}: ${words}`, x, y, tone, heading_rad };
      window.getElement(this.scene.map)?.show(this.scene.layer, x === null ? [] : [mark], false);
    },
  },
  methods: {
    fetchAll() {
      // Before somebody moves the slider: a picture that comes late would be that of another moment.
      for (const { url } of this.scene.pictures) new Image().src = url;
    },
  },
};
