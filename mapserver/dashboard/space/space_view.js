// A version in three dimensions. Words of robots are painted as text, never markup.
import { OrbitControls, THREE } from "nicegui-scene";

// A scale that is told apart without red and green, from low to high.
const SCALE = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const TONES = { good: "#14924b", warn: "#c77700", bad: "#d1342f", quiet: "#8a9099" };
const LOW_M = 0, HIGH_M = 6;
const FRUSTUM_M = 0.25, ROBOT_VIEW = 4; // a robot's is so many times as long
const TURN_DEG = 15, STEP_EVERY_MS = 700, FAR_M = 3;
const VIEW_EVERY_MS = 1200, STILL_MS = 250; // the server draws one a second for an address
const LOOPS = { loops: "#14924b", "refused loops": "#d1342f" };
// Keys of the walk, as buttons say them.
const KEYS = {
  ArrowUp: "forward", w: "forward", ArrowDown: "back", s: "back", ArrowLeft: "left", a: "left", ArrowRight: "right", d: "right",
  Home: "begin", " ": "play", Escape: "leave",
};

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
      <div class="views" :class="{ walking }">
        <canvas tabindex="0" role="img" :aria-label="scene.label"></canvas>
        <figure v-if="walking && scene.view" class="expected"><img :src="view || empty" :alt="viewWords"><figcaption>{{ viewWords }}</figcaption></figure>
      </div>
      <div class="controls">
        <button v-if="!walking" type="button" class="plain forward walk" :disabled="!places" @click="walkTo()">Walk through it</button>
        <template v-else>
          <button v-for="[act, words] in acts" type="button" class="plain" @click="walk(act)">{{ words }}</button>
        </template>
      </div>
      <p v-if="walking" class="where" role="status">{{ where }}</p>
      <div class="controls">
        <label>Colour <select v-model="colour"><option value="height">height</option><option value="exactness">how exactly it is known</option></select></label>
        <label v-for="name in names"><input type="checkbox" v-model="visible[name]"> {{ name }}</label>
        <button type="button" class="plain" @click="look('above')">From above</button>
        <button type="button" class="plain" @click="look('aside')">From aside</button>
      </div>
      <p class="quiet scale"><span>{{ ends[0] }}</span><i></i><span>{{ ends[1] }}</span></p>
    </div>`,
  props: { scene: Object },
  data() {
    const visible = { landmarks: true, places: true, robots: true, loops: false, "refused loops": false };
    return { colour: "height", visible, trouble: "", walking: false, playing: false, places: 0, at: 0, turn: 0, jump: 0, view: "", viewWords: "" };
  },
  computed: {
    empty: () => "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7",
    names() {
      const has = { loops: this.scene.loops.some((loop) => loop[4]), "refused loops": this.scene.loops.some((loop) => !loop[4]) };
      return Object.keys(this.visible).filter((name) => has[name] ?? true);
    },
    acts() {
      const play = ["play", this.playing ? "Stop" : "Go along"];
      return [["forward", "Forward"], ["back", "Back"], ["left", "Turn left"], ["right", "Turn right"], play, ["leave", "Leave the walk"]];
    },
    where() {
      const jump = this.jump > FAR_M ? ` The survey goes on ${this.jump.toFixed(0)} m from the last one.` : "";
      return `Place ${this.at + 1} of ${this.places}.${jump}`;
    },
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
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.05, 2000);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.listenToKeyEvents(canvas);
    this.controls.maxPolarAngle = 0.495 * Math.PI;
    this.controls.addEventListener("change", () => this.draw());
    this.controls.addEventListener("start", () => (this.from = null));
    this.groups = Object.fromEntries(Object.keys(this.visible).map((name) => [name, new THREE.Group()]));
    for (const [name, group] of Object.entries(this.groups)) this.world.add(Object.assign(group, { visible: this.visible[name] }));
    canvas.addEventListener("keydown", (event) => {
      const act = KEYS[event.key];
      if (!this.walking || !act || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      this.walk(act);
    });
    this.$el.style.setProperty("--aspect", this.scene.tangents[0] / this.scene.tangents[1]);
    this.resized = new ResizeObserver(() => this.fit());
    this.resized.observe(canvas);
    this.$el.seen = () => this.seen();
    await this.fetchMap();
    this.showRobots(this.scene.robots);
    this.fit();
    if (!this.walking) this.look("aside");
  },
  unmounted() {
    clearInterval(this.player);
    clearTimeout(this.viewTimer);
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
      this.rows = new Float32Array(bytes, 8 + 12 * count, 12 * places);
      this.places = places;
      this.groups.places.add(this.frustums(this.rows));
      this.drawLoops();
      this.box = new THREE.Box3().setFromArray(count ? this.points : [-5, -5, 0, 5, 5, 2]);
      this.paint();
    },
    frustums(rows, tangents) {
      // Four rays from each camera's centre, and the rectangle that they end at; tangents of its edges: the survey's without any.
      const [wide, high] = this.scene.tangents;
      const [left, right, upper, lower] = tangents ?? [-wide, wide, -high, high];
      const corners = [[left, upper], [right, upper], [right, lower], [left, lower]].map((xy) => [...xy, 1].map((side) => side * FRUSTUM_M));
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
        const own = this.scene.cameras[robot.name];
        const mounted = own ? own.slice(4) : [0, 0, 1, 0.35, -1, 0, 0, 0, 0, -1, 0, 0.4];
        const view = this.frustums(new Float32Array(mounted.map((value, n) => (n % 4 < 3 ? ROBOT_VIEW * value : value))), own?.slice(0, 4));
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
    drawLoops() {
      // Reports tell ends from above: each is drawn at the height of the place nearest to it.
      const ends = { loops: [], "refused loops": [] };
      for (const [x0, y0, x1, y1, accepted] of this.scene.loops) {
        const line = [[x0, y0], [x1, y1]].map(([x, y]) => [x, y, this.places ? this.placed(this.nearest(x, y)).z : 0]);
        ends[accepted ? "loops" : "refused loops"].push(...line.flat());
      }
      for (const [name, lines] of Object.entries(ends)) {
        const shape = new THREE.BufferGeometry();
        shape.setAttribute("position", new THREE.Float32BufferAttribute(lines, 3));
        this.groups[name].add(new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: LOOPS[name] })));
      }
    },
    placed(n) {
      // Where a place's camera stood, its heading and how far it looked down, in degrees.
      const [x, y, z] = [3, 7, 11].map((row) => this.rows[12 * n + row]);
      const forward = [2, 6, 10].map((row) => this.rows[12 * n + row]);
      const degrees = 180 / Math.PI;
      return { x, y, z, yaw: Math.atan2(forward[1], forward[0]) * degrees, pitch: -Math.asin(Math.max(-1, Math.min(1, forward[2]))) * degrees };
    },
    nearest(x, y) {
      let best = 0, least = Infinity;
      for (let n = 0; n < this.places; n++) {
        const away = (this.rows[12 * n + 3] - x) ** 2 + (this.rows[12 * n + 7] - y) ** 2;
        if (away < least) [best, least] = [n, away];
      }
      return best;
    },
    async walkTo(x, y) {
      while (!this.box && !this.trouble) await new Promise((done) => setTimeout(done, 50)); // the map is on its way
      if (!this.places) return;
      if (x !== undefined) [this.at, this.turn, this.jump] = [this.nearest(x, y), 0, 0];
      this.walking = true;
      this.controls.enabled = false;
      await this.$nextTick();
      this.$el.querySelector("canvas").focus({ preventScroll: true });
      this.fit();
      this.stand();
    },
    walk(act) {
      if (act === "leave") return this.leave();
      if (act === "play") return this.play(!this.playing);
      if (act === "left" || act === "right") this.turn = (this.turn + (act === "left" ? TURN_DEG : -TURN_DEG)) % 360;
      else {
        // Who looks back walks back.
        const ahead = Math.cos((this.turn * Math.PI) / 180) < -0.01 ? -1 : 1;
        const to = act === "begin" ? 0 : Math.max(0, Math.min(this.places - 1, this.at + (act === "forward" ? ahead : -ahead)));
        const [from, next] = [this.placed(this.at), this.placed(to)];
        this.jump = act === "begin" ? 0 : Math.hypot(next.x - from.x, next.y - from.y);
        this.at = to;
      }
      this.stand();
    },
    play(on) {
      clearInterval(this.player);
      this.playing = on;
      if (!on) return;
      this.player = setInterval(() => {
        const before = this.at;
        this.walk("forward");
        if (this.at === before) this.play(false);
      }, STEP_EVERY_MS);
    },
    leave() {
      this.play(false);
      this.walking = false;
      this.controls.enabled = true;
      this.camera.fov = 50;
      this.$nextTick(() => {
        this.fit();
        this.look("aside");
      });
    },
    stand() {
      const { x, y, z, yaw, pitch } = this.placed(this.at), heading = yaw + this.turn, rad = Math.PI / 180;
      this.camera.position.set(x, y, z);
      const level = Math.cos(pitch * rad);
      this.camera.lookAt(x + level * Math.cos(heading * rad), y + level * Math.sin(heading * rad), z - Math.sin(pitch * rad));
      this.draw();
      this.$emit("walked", { x, y, heading: ((((heading + 180) % 360) + 360) % 360 - 180) * rad });
      if (this.scene.view) this.expect({ x_m: x, y_m: y, z_m: z, yaw_deg: ((heading % 360) + 360) % 360, pitch_deg: pitch });
    },
    expect(pose) {
      // The last place that one stands still at, and no more of them than the server draws.
      clearTimeout(this.viewTimer);
      const wait = Math.max(STILL_MS, (this.viewAsked ?? 0) + VIEW_EVERY_MS - Date.now());
      this.viewTimer = setTimeout(() => {
        this.viewAsked = Date.now();
        const query = Object.entries(pose).map(([name, value]) => `${name}=${value.toFixed(3)}`).join("&");
        const picture = new Image(), place = this.at + 1;
        picture.onload = () => {
          this.view = picture.src;
          this.viewWords = `Drawn from the surfels: what the survey's camera should see at place ${place}`;
        };
        picture.onerror = () => (this.viewWords = "The server did not draw this view; step on to ask again");
        picture.src = `${this.scene.view}?${query}`;
      }, wait);
    },
    look(from) {
      if (!this.box) return;
      if (this.walking) return this.leave();
      this.from = from;
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
      if (this.walking) this.camera.fov = (2 * Math.atan(this.scene.tangents[1]) * 180) / Math.PI;
      this.camera.updateProjectionMatrix();
      if (!this.walking && this.from) this.look(this.from); // until somebody moves it, everything is in sight
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
        const view = mark.children[2]?.geometry.getAttribute("position").array;
        return { ...robot, view: view && Array.from(view), page: [(on.x + 1) / 2, (1 - on.y) / 2] };
      };
      const loops = Object.fromEntries(Object.keys(LOOPS).map((name) => [name, this.scene.loops.filter((loop) => (name === "loops") === !!loop[4]).length]));
      const { x, y, z } = this.camera.position;
      return { landmarks: this.exactness?.length ?? 0, loops, camera: [x, y, z], at: this.at, robots: [...(this.drawn?.values() ?? [])].map(at) };
    },
  },
};
