// A version in three dimensions. Words of robots are painted as text, never markup.
import { OrbitControls, THREE } from "nicegui-scene";

// A scale that is told apart without red and green, from low to high.
const SCALE = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const TONES = { good: "#14924b", warn: "#c77700", bad: "#d1342f", quiet: "#8a9099" };
const LOW_M = 0, HIGH_M = 6;
const FRUSTUM_M = 0.25;

function scaled(share) {
  const at = Math.min(0.9999, Math.max(0, share)) * (SCALE.length - 1), n = Math.floor(at);
  return SCALE[n].map((low, axis) => (low + (at - n) * (SCALE[n + 1][axis] - low)) / 255);
}

function nameOf(robot) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [256, 64];
  const pen = canvas.getContext("2d");
  pen.font = "600 30px sans-serif";
  const width = Math.min(250, pen.measureText(robot.name).width + 16);
  pen.fillStyle = TONES[robot.tone] || TONES.quiet;
  pen.fillRect(128 - width / 2, 8, width, 48);
  pen.fillStyle = "#fff";
  pen.textAlign = "center";
  pen.fillText(robot.name, 128, 42, 240);
  const texture = new THREE.CanvasTexture(canvas);
  texture.colorSpace = THREE.SRGBColorSpace;
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map: texture, depthTest: false, sizeAttenuation: false }));
  sprite.scale.set(0.16, 0.04, 1);
  sprite.position.set(0, 0, 1.2);
  return sprite;
}

export default {
  template: `
    <div>
      <p v-if="trouble" class="notice bad">{{ trouble }}</p>
      <canvas tabindex="0" role="img" :aria-label="scene.label"></canvas>
      <div class="controls">
        <label>Colour <select v-model="colour"><option value="height">height</option><option value="exactness">how exactly it is known</option></select></label>
        <label v-for="name in ['landmarks', 'places', 'robots']"><input type="checkbox" v-model="visible[name]"> {{ name }}</label>
        <button type="button" @click="look('above')">From above</button>
        <button type="button" @click="look('aside')">From aside</button>
      </div>
      <p class="quiet scale"><span>{{ ends[0] }}</span><i></i><span>{{ ends[1] }}</span></p>
    </div>`,
  props: { scene: Object },
  data() {
    return { colour: "height", visible: { landmarks: true, places: true, robots: true }, trouble: "" };
  },
  computed: {
    ends() {
      if (this.colour === "height") return [`${LOW_M} m`, `${HIGH_M} m and above`];
      return this.scene.exactness.map((mm, n) => (n ? `${mm} mm or worse` : `${mm} mm or better`));
    },
  },
  watch: {
    colour() {
      this.paint();
    },
    visible: {
      deep: true,
      handler() {
        for (const [name, group] of Object.entries(this.groups || {})) group.visible = this.visible[name];
        this.draw();
      },
    },
  },
  async mounted() {
    const canvas = this.$el.querySelector("canvas");
    try {
      this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    } catch {
      this.trouble = "This browser draws nothing in three dimensions (WebGL is off); the map page shows the same from above.";
      return;
    }
    this.world = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.1, 2000);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.listenToKeyEvents(canvas);
    this.controls.maxPolarAngle = 0.495 * Math.PI;
    this.controls.addEventListener("change", () => this.draw());
    this.groups = { landmarks: new THREE.Group(), places: new THREE.Group(), robots: new THREE.Group() };
    Object.values(this.groups).forEach((group) => this.world.add(group));
    this.resized = new ResizeObserver(() => this.fit());
    this.resized.observe(canvas);
    this.$el.seen = () => this.seen();
    await this.fetchMap();
    this.showRobots(this.scene.robots);
    this.fit();
    this.look("aside");
  },
  unmounted() {
    this.resized?.disconnect();
    this.renderer?.dispose();
  },
  methods: {
    async fetchMap() {
      const answer = await fetch(this.scene.address);
      if (!answer.ok) {
        this.trouble = `The map could not be fetched: ${await answer.text()}`;
        return;
      }
      const bytes = await answer.arrayBuffer(), head = new DataView(bytes);
      const [count, places] = [head.getUint32(0, true), head.getUint32(4, true)];
      this.points = new Float32Array(bytes, 8, 3 * count);
      this.exactness = new Uint8Array(bytes, 8 + 12 * count + 48 * places, count);
      const shape = new THREE.BufferGeometry();
      shape.setAttribute("position", new THREE.BufferAttribute(this.points, 3));
      shape.setAttribute("color", new THREE.BufferAttribute(new Float32Array(3 * count), 3));
      this.groups.landmarks.add(new THREE.Points(shape, new THREE.PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: true })));
      this.groups.places.add(this.frustums(new Float32Array(bytes, 8 + 12 * count, 12 * places)));
      this.box = new THREE.Box3().setFromArray(count ? this.points : [-5, -5, 0, 5, 5, 2]);
      this.paint();
    },
    frustums(rows) {
      // Four rays from each camera's centre, and the rectangle that they end at.
      const corners = [[-1, -0.75], [1, -0.75], [1, 0.75], [-1, 0.75]].map(([x, y]) => [0.6 * x * FRUSTUM_M, 0.6 * y * FRUSTUM_M, FRUSTUM_M]);
      const lines = [];
      for (let n = 0; n < rows.length; n += 12) {
        const moved = ([x, y, z]) => [0, 4, 8].map((row) => rows[n + row] * x + rows[n + row + 1] * y + rows[n + row + 2] * z + rows[n + row + 3]);
        const centre = moved([0, 0, 0]), ends = corners.map(moved);
        ends.forEach((end, k) => lines.push(...centre, ...end, ...end, ...ends[(k + 1) % 4]));
      }
      const shape = new THREE.BufferGeometry();
      shape.setAttribute("position", new THREE.Float32BufferAttribute(lines, 3));
      return new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: "#3278eb", transparent: true, opacity: 0.6 }));
    },
    paint() {
      if (!this.points) return;
      const colours = this.groups.landmarks.children[0].geometry.getAttribute("color");
      for (let n = 0; n < this.exactness.length; n++) {
        const share = this.colour === "height" ? (this.points[3 * n + 2] - LOW_M) / (HIGH_M - LOW_M) : this.exactness[n] / 255;
        colours.setXYZ(n, ...scaled(share));
      }
      colours.needsUpdate = true;
      this.draw();
    },
    showRobots(robots) {
      if (!this.groups) return;
      this.drawn ||= new Map();
      const named = new Map(robots.map((robot) => [robot.name, robot]));
      for (const [name, { mark }] of this.drawn) {
        const now = named.get(name);
        if (now && now.tone === mark.userData.tone) continue;
        this.groups.robots.remove(mark);
        this.drawn.delete(name);
      }
      for (const robot of robots) {
        const mark = this.drawn.get(robot.name)?.mark || this.markOf(robot);
        mark.position.set(robot.x, robot.y, 0);
        mark.rotation.z = robot.heading_rad || 0;
        this.drawn.set(robot.name, { mark, robot });
      }
      this.draw();
    },
    markOf(robot) {
      const mark = new THREE.Group(), material = new THREE.MeshBasicMaterial({ color: TONES[robot.tone] || TONES.quiet });
      const body = new THREE.Mesh(new THREE.BoxGeometry(0.7, 0.5, 0.35), material);
      body.position.z = 0.2;
      mark.add(body, nameOf(robot));
      if (robot.heading_rad !== null) {
        const view = this.frustums(new Float32Array([0, 0, 4, 0.35, -4, 0, 0, 0, 0, -4, 0, 0.4]));
        view.material.color.set(TONES[robot.tone] || TONES.quiet);
        mark.add(view);
      }
      mark.userData.tone = robot.tone;
      this.groups.robots.add(mark);
      return mark;
    },
    nameThem() {
      // Troubled robots first, then the nearest; names do not cover each other.
      const order = { bad: 0, warn: 1, good: 2, quiet: 3 }, taken = [];
      const marks = [...(this.drawn?.values() ?? [])].map(({ mark }) => ({
        name: mark.children[1],
        on: mark.position.clone().project(this.camera),
        rank: [order[mark.userData.tone] ?? 3, mark.position.distanceTo(this.camera.position)],
      }));
      marks.sort((one, other) => one.rank[0] - other.rank[0] || one.rank[1] - other.rank[1]);
      for (const { name, on } of marks) {
        name.visible = !taken.some((there) => Math.abs(there.x - on.x) < 0.18 / this.camera.aspect * 2 && Math.abs(there.y - on.y) < 0.09);
        if (name.visible) taken.push(on);
      }
    },
    look(from) {
      if (!this.box) return;
      const middle = this.box.getCenter(new THREE.Vector3()), size = this.box.getSize(new THREE.Vector3());
      const away = 1.1 * Math.max(size.x, size.y, 4) * Math.max(1, 1.6 / this.camera.aspect);
      this.controls.target.set(middle.x, middle.y, 1);
      this.camera.position.set(middle.x, middle.y - (from === "above" ? 0.01 : 0.55 * away), from === "above" ? 0.8 * away : 0.38 * away);
      this.controls.update();
      this.draw();
    },
    fit() {
      const { clientWidth, clientHeight } = this.renderer.domElement;
      if (!clientWidth || !clientHeight) return;
      this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
      this.renderer.setSize(clientWidth, clientHeight, false);
      this.camera.aspect = clientWidth / clientHeight;
      this.camera.updateProjectionMatrix();
      this.draw();
    },
    draw() {
      if (!this.renderer || this.asked) return;
      this.asked = requestAnimationFrame(() => {
        this.asked = 0;
        this.nameThem();
        this.renderer.render(this.world, this.camera);
      });
    },
    seen() {
      const at = ({ mark, robot }) => {
        const on = mark.position.clone().project(this.camera);
        return { ...robot, page: [(on.x + 1) / 2, (1 - on.y) / 2] };
      };
      return { landmarks: this.exactness?.length ?? 0, robots: [...(this.drawn?.values() ?? [])].map(at) };
    },
  },
};
