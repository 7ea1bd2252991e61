// A version in three dimensions, and a walk along the places of its surveys. Words of robots are painted as text, never markup.
import * as THREE from "./vendor/three/three.js";
import "../../static/map/index.js";
import { follow } from "../../static/stream.js";

// A scale that is told apart without red and green, from low to high.
const SCALE = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];
const TONES = { good: "#14924b", warn: "#c77700", bad: "#d1342f", quiet: "#8a9099", accent: "#3278eb" };
const LOW_M = 0, HIGH_M = 6;
const FIELD_DEG = 50;
const FRUSTUM_M = 0.25, ROBOT_VIEW = 4; // a robot's is so many times as long
const TURN_DEG = 15, STEP_EVERY_MS = 700, FAR_M = 3;
const VIEW_EVERY_MS = 1200, STILL_MS = 250; // the server draws one a second for an address
const BAR_PX = 140, REACH_PX = 12, STILL_PX = 4;
const BEHIND = 1.05; // times as far away: another surface
const RAD = Math.PI / 180, CLOCKS_BEGIN_MS = Date.UTC(2000); // earlier stamps count from a start, not from 1970
// Keys of the walk, as its buttons are called.
const KEYS = {
  ArrowUp: "forward", w: "forward", ArrowDown: "back", s: "back", ArrowLeft: "left", a: "left", ArrowRight: "right", d: "right",
  Home: "begin", " ": "play", Escape: "leave",
};

const element = document.querySelector(".space-view");
const [canvas, where, bar, picture, caption, taken, takenCaption] = ["canvas", ".where", ".bar", ".expected img", "figcaption", ".taken img", ".taken figcaption"].map((part) => element.querySelector(part));
const scene = JSON.parse(element.dataset.space);
const world = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(FIELD_DEG, 1, 0.05, 2000);
const groups = Object.fromEntries(["surfels", "landmarks", "places", "robots", "floor", "loops", "refused loops", "measured"].map((name) => [name, new THREE.Group()]));
const robots = new Map(); // name: what is drawn, and what the server says of it
let renderer, controls, box, points, exactness, rows, asked, player, viewTimer;
let [places, at, turn, viewAsked] = [0, 0, 0, 0];
let measuring; // the ends that were clicked
let from = "aside"; // until somebody moves it, everything is in sight

const about = where.textContent;
const isWalking = () => element.classList.contains("walking");
const say = (words, tone = "") => ([where.textContent, where.className] = [words, `line where ${tone}`]);
// The next lower of 1, 2, 5, 10, 20, ...
const rounded = (value) => [5, 2, 1].map((digit) => digit * 10 ** Math.floor(Math.log10(value))).find((step) => step <= value);

function scaled(share) {
  const at = Math.min(0.9999, Math.max(0, share)) * (SCALE.length - 1), n = Math.floor(at);
  return SCALE[n].map((low, axis) => (low + (at - n) * (SCALE[n + 1][axis] - low)) / 255);
}

function sign(words, ink, ground) {
  const paper = Object.assign(document.createElement("canvas"), { width: 256, height: 64 });
  const pen = paper.getContext("2d");
  pen.font = "600 30px sans-serif";
  pen.textAlign = "center";
  if (ground) {
    const width = Math.min(250, pen.measureText(words).width + 16);
    pen.fillStyle = ground;
    pen.fillRect(128 - width / 2, 8, width, 48);
  }
  pen.fillStyle = ink;
  pen.fillText(words, 128, 42, 240);
  const texture = new THREE.CanvasTexture(paper);
  texture.colorSpace = THREE.SRGBColorSpace;
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map: texture, depthTest: false, sizeAttenuation: false }));
  sprite.scale.set(0.16, 0.04, 1);
  return sprite;
}

function lines(ends, color, opacity = 1) {
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.Float32BufferAttribute(ends, 3));
  return new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color, transparent: true, opacity }));
}

// Four rays from each camera's centre, and the rectangle that they end at; tangents of its edges: the survey's without any.
function frustums(rows, color, tangents) {
  const [wide, high] = scene.tangents;
  const [left, right, upper, lower] = tangents ?? [-wide, wide, -high, high];
  const corners = [[left, upper], [right, upper], [right, lower], [left, lower]].map((xy) => [...xy, 1].map((side) => side * FRUSTUM_M));
  const ends = [];
  for (let n = 0; n < rows.length; n += 12) {
    const moved = ([x, y, z]) => [0, 4, 8].map((row) => rows[n + row] * x + rows[n + row + 1] * y + rows[n + row + 2] * z + rows[n + row + 3]);
    const centre = moved([0, 0, 0]), edge = corners.map(moved);
    edge.forEach((corner, k) => ends.push(...centre, ...corner, ...corner, ...edge[(k + 1) % 4]));
  }
  return lines(ends, color, 0.6);
}

async function fetched(address, what) {
  const answer = await fetch(address);
  if (!answer.ok) throw new Error(`The ${what} could not be fetched: ${await answer.text()}`);
  return answer.arrayBuffer();
}

async function fetchMap() {
  const bytes = await fetched(scene.address, "map"), head = new DataView(bytes);
  const count = head.getUint32(0, true);
  places = head.getUint32(4, true);
  points = new Float32Array(bytes, 8, 3 * count);
  rows = new Float32Array(bytes, 8 + 12 * count, 12 * places);
  exactness = new Uint8Array(bytes, 8 + 12 * count + 48 * places, count);
  box = new THREE.Box3().setFromArray(count ? points : [-5, -5, 0, 5, 5, 2]);
}

// What three.js makes of a grey level of a picture.
const LINEAR = Uint16Array.from({ length: 256 }, (_, grey) => 65535 * new THREE.Color().setRGB(grey / 255, 0, 0, THREE.SRGBColorSpace).r);

function cloud(places, colours, look) {
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.BufferAttribute(places, 3));
  shape.setAttribute("color", colours);
  return new THREE.Points(shape, new THREE.PointsMaterial({ vertexColors: true, ...look }));
}

// A cloud for each level, as wide as its voxels.
async function drawSurfels() {
  const bytes = await fetched(scene.surfels, "surfels"), levels = new DataView(bytes).getUint32(0, true);
  const counts = new Uint32Array(bytes, 4, levels), edges = new Float32Array(bytes, 4 + 4 * levels, levels);
  const first = 4 + 8 * levels, total = counts.reduce((sum, count) => sum + count, 0);
  let begun = 0;
  counts.forEach((count, level) => {
    const greys = new Uint8Array(bytes, first + 12 * total + begun, count);
    const colours = Uint16Array.from({ length: 3 * count }, (_, n) => LINEAR[greys[Math.floor(n / 3)]]);
    const places = new Float32Array(bytes, first + 12 * begun, 3 * count);
    groups.surfels.add(cloud(places, new THREE.BufferAttribute(colours, 3, true), { size: 1.5 * edges[level] }));
    begun += count;
  });
  draw();
}

function drawMap() {
  const colours = new THREE.BufferAttribute(new Float32Array(points.length), 3);
  groups.landmarks.add(cloud(points, colours, { size: 2, sizeAttenuation: false }));
  groups.places.add(frustums(rows, TONES.accent));
  // Reports tell ends from above: each is drawn at the height of the place nearest to it.
  const ends = { loops: [], "refused loops": [] };
  for (const [x0, y0, x1, y1, accepted] of scene.loops) {
    const height = (x, y) => (places ? placed(nearest(x, y)).z : 0);
    ends[accepted ? "loops" : "refused loops"].push(x0, y0, height(x0, y0), x1, y1, height(x1, y1));
  }
  groups.loops.add(lines(ends.loops, TONES.good));
  groups["refused loops"].add(lines(ends["refused loops"], TONES.bad));
  drawFloor();
  paint();
}

// A grid at the height of the map's origin, with metres along two of its edges and the axes.
function drawFloor() {
  const step = Math.max(1, rounded(Math.max(box.max.x - box.min.x, box.max.y - box.min.y) / 10));
  const [x0, y0] = [box.min.x, box.min.y].map((low) => step * Math.floor(low / step));
  const [x1, y1] = [box.max.x, box.max.y].map((high) => step * Math.ceil(high / step));
  const ends = [];
  const name = (words, ink, x, y) => groups.floor.add(sign(words, ink).translateX(x).translateY(y));
  for (let x = x0; x <= x1; x += step) ends.push(x, y0, 0, x, y1, 0), name(`${x}`, TONES.quiet, x, y0 - 0.3 * step);
  for (let y = y0; y <= y1; y += step) ends.push(x0, y, 0, x1, y, 0), name(`${y}`, TONES.quiet, x0 - 0.3 * step, y);
  groups.floor.add(lines(ends, TONES.quiet, 0.5), lines([0, 0, 0, step, 0, 0], TONES.bad), lines([0, 0, 0, 0, step, 0], TONES.good));
  name("x (m)", TONES.bad, x1 + 0.7 * step, y0 - 0.3 * step), name("y (m)", TONES.good, x0 - 0.3 * step, y1 + 0.7 * step);
}

function paint() {
  const chosen = element.querySelector("[name=colour]");
  const colours = groups.landmarks.children[0].geometry.getAttribute("color");
  for (let n = 0; n < exactness.length; n++) {
    const share = chosen.value === "height" ? (points[3 * n + 2] - LOW_M) / (HIGH_M - LOW_M) : exactness[n] / 255;
    colours.setXYZ(n, ...scaled(share));
  }
  colours.needsUpdate = true;
  const ends = chosen.selectedOptions[0].dataset.ends.split("|");
  element.querySelectorAll(".scale span").forEach((end, n) => (end.textContent = ends[n]));
  draw();
}

function showRobots(told) {
  for (const [name, { mark, robot }] of robots) {
    if (told.some((now) => now.name === name && now.tone === robot.tone)) continue;
    groups.robots.remove(mark);
    robots.delete(name);
  }
  for (const robot of told) {
    const mark = robots.get(robot.name)?.mark ?? markOf(robot);
    mark.position.set(robot.x, robot.y, 0);
    mark.rotation.z = robot.heading_rad ?? 0;
    robots.set(robot.name, { mark, robot });
  }
  draw();
}

function markOf({ name, tone, heading_rad: heading }) {
  const mark = new THREE.Group(), color = TONES[tone] ?? TONES.quiet;
  const body = new THREE.Mesh(new THREE.BoxGeometry(0.7, 0.5, 0.35), new THREE.MeshBasicMaterial({ color }));
  mark.add(body.translateZ(0.2), sign(name, "#fff", color).translateZ(1.2));
  if (heading !== null) {
    const own = scene.cameras[name];
    const mounted = own ? own.slice(4) : [0, 0, 1, 0.35, -1, 0, 0, 0, 0, -1, 0, 0.4];
    mark.add(frustums(mounted.map((value, n) => (n % 4 < 3 ? ROBOT_VIEW * value : value)), color, own?.slice(0, 4)));
  }
  groups.robots.add(mark);
  return mark;
}

// Troubled robots first, then the nearest; names do not cover each other.
function nameRobots() {
  const order = { bad: 0, warn: 1, good: 2, quiet: 3 }, taken = [];
  const marks = [...robots.values()].map(({ mark, robot }) => ({
    name: mark.children[1],
    on: mark.position.clone().project(camera),
    rank: [order[robot.tone] ?? 3, mark.position.distanceTo(camera.position)],
  }));
  marks.sort((one, other) => one.rank[0] - other.rank[0] || one.rank[1] - other.rank[1]);
  for (const { name, on } of marks) {
    name.visible = !taken.some((there) => Math.abs(there.x - on.x) < 0.36 / camera.aspect && Math.abs(there.y - on.y) < 0.09);
    if (name.visible) taken.push(on);
  }
}

// Where a place's camera stood, its heading and how far it looked down, in degrees.
function placed(n) {
  const [x, y, z] = [3, 7, 11].map((row) => rows[12 * n + row]);
  const forward = [2, 6, 10].map((row) => rows[12 * n + row]);
  return { x, y, z, yaw: Math.atan2(forward[1], forward[0]) / RAD, pitch: -Math.asin(Math.max(-1, Math.min(1, forward[2]))) / RAD };
}

function nearest(x, y) {
  let best = 0, least = Infinity;
  for (let n = 0; n < places; n++) {
    const away = (rows[12 * n + 3] - x) ** 2 + (rows[12 * n + 7] - y) ** 2;
    if (away < least) [best, least] = [n, away];
  }
  return best;
}

// The robot, or the number of the place, that the pointer is on.
function pointedAt({ offsetX, offsetY }) {
  const spot = new THREE.Vector3();
  let best, least = REACH_PX;
  const offer = (found, x, y, z) => {
    spot.set(x, y, z).project(camera);
    const away = Math.hypot(((spot.x + 1) / 2) * canvas.clientWidth - offsetX, ((1 - spot.y) / 2) * canvas.clientHeight - offsetY);
    if (spot.z < 1 && away < least) [best, least] = [found, away];
  };
  if (groups.robots.visible) for (const { robot } of robots.values()) offer(robot, robot.x, robot.y, 0.2);
  if (best === undefined && groups.places.visible) for (let n = 0; n < places; n++) offer(n, rows[12 * n + 3], rows[12 * n + 7], rows[12 * n + 11]);
  return best;
}

// The point of what is shown that is nearest to the pointer, of the foremost ones within its reach.
function surfaceAt({ offsetX, offsetY }) {
  const seen = new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse).elements;
  const [x, y] = [(2 * offsetX) / canvas.clientWidth - 1, 1 - (2 * offsetY) / canvas.clientHeight];
  const [wide, high] = [canvas.clientWidth, canvas.clientHeight].map((side) => (2 * REACH_PX) / side);
  const found = [];
  for (const cloud of [groups.surfels, groups.landmarks].filter((group) => group.visible).flatMap((group) => group.children)) {
    const at = cloud.geometry.getAttribute("position").array;
    for (let n = 0; n < at.length; n += 3) {
      const row = (k) => seen[k] * at[n] + seen[k + 4] * at[n + 1] + seen[k + 8] * at[n + 2] + seen[k + 12];
      const away = row(3);
      if (away <= 0) continue;
      const off = [(row(0) / away - x) / wide, (row(1) / away - y) / high];
      if (Math.max(...off.map(Math.abs)) < 1) found.push({ away, off: Math.hypot(...off), at: at.subarray(n, n + 3) });
    }
  }
  const foremost = found.reduce((least, { away }) => Math.min(least, away), Infinity);
  const [best] = found.filter(({ away }) => away < BEHIND * foremost).sort((one, other) => one.off - other.off);
  return best && new THREE.Vector3(...best.at);
}

function measure(event) {
  const end = surfaceAt(event);
  if (!end) return say("Nothing is drawn there; click on a surface or a landmark.");
  if (measuring.length === 2) (measuring = []), groups.measured.clear();
  measuring.push(end);
  const [one, other] = measuring;
  if (!other) return say("Click on the other end.");
  const words = `${one.distanceTo(other).toFixed(2)} m`;
  groups.measured.add(lines([...one, ...other], TONES.accent), sign(words, "#fff", TONES.accent).translateX((one.x + other.x) / 2).translateY((one.y + other.y) / 2).translateZ((one.z + other.z) / 2));
  say(`${words} apart: ${Math.hypot(one.x - other.x, one.y - other.y).toFixed(2)} m along the floor, ${Math.abs(one.z - other.z).toFixed(2)} m in height.`);
  draw();
}

function walkTo(place) {
  if (!places) return;
  [at, turn] = [place, 0];
  element.classList.add("walking");
  controls.enabled = false;
  canvas.focus({ preventScroll: true });
  fit();
  stand();
}

const ACTS = {
  start: () => walkTo(at),
  above: () => look("above"),
  aside: () => look("aside"),
  measure() {
    measuring = measuring ? undefined : [];
    groups.measured.clear();
    element.querySelector("[data-do=measure]").setAttribute("aria-pressed", Boolean(measuring));
    say(measuring ? "Click on one end of the distance." : about);
    draw();
  },
  left: () => ((turn = (turn + TURN_DEG) % 360), stand()),
  right: () => ((turn = (turn - TURN_DEG) % 360), stand()),
  begin: () => ((at = 0), stand()),
  forward: () => step(1),
  back: () => step(-1),
  play: () => play(!player),
  leave() {
    play(false);
    element.classList.remove("walking");
    controls.enabled = true;
    camera.fov = FIELD_DEG;
    fit();
    look("aside");
    say(about);
  },
};

function step(way) {
  const ahead = Math.cos(turn * RAD) < -0.01 ? -way : way; // who looks back walks back
  const before = placed(at);
  at = Math.max(0, Math.min(places - 1, at + ahead));
  const now = placed(at);
  stand(Math.hypot(now.x - before.x, now.y - before.y));
}

function play(on) {
  clearInterval(player);
  element.querySelector("[data-do=play]").textContent = on ? "Stop" : "Go along";
  player = on && setInterval(() => {
    const before = at;
    step(1);
    if (at === before) play(false);
  }, STEP_EVERY_MS);
}

function stand(jump_m = 0) {
  const { x, y, z, yaw, pitch } = placed(at), heading = yaw + turn, level = Math.cos(pitch * RAD);
  camera.position.set(x, y, z);
  camera.lookAt(x + level * Math.cos(heading * RAD), y + level * Math.sin(heading * RAD), z - Math.sin(pitch * RAD));
  draw();
  say(`Place ${at + 1} of ${places}.${jump_m > FAR_M ? ` The survey goes on ${jump_m.toFixed(0)} m from the last one.` : ""}`);
  const here = { kind: "mark", x, y, tone: "accent", shape: "arrow", words: "you", name: "you", address: null };
  here.heading_rad = ((((heading + 180) % 360) + 360) % 360 - 180) * RAD;
  document.getElementById("plan").map.show("Where you stand", [here]);
  expect({ x_m: x, y_m: y, z_m: z, yaw_deg: ((heading % 360) + 360) % 360, pitch_deg: pitch });
}

// The last place that one stands still at, and no more of them than the server draws.
function expect(pose) {
  clearTimeout(viewTimer);
  const place = at + 1;
  viewTimer = setTimeout(() => {
    viewAsked = Date.now();
    if (scene.pictures) recall(pose);
    if (!scene.view) return;
    const next = new Image();
    next.onload = () => {
      picture.src = next.src;
      caption.textContent = `Drawn from the surfels: what the survey's camera should see at place ${place}`;
    };
    next.onerror = () => (caption.textContent = "The server did not draw this view; step on to ask again");
    next.src = `${scene.view}?${Object.entries(pose).map(([name, value]) => `${name}=${value.toFixed(3)}`).join("&")}`;
  }, Math.max(STILL_MS, viewAsked + VIEW_EVERY_MS - Date.now()));
}

// The picture that a survey took next to a place, looking the same way where there is one.
async function recall({ pitch_deg: _, ...pose }) {
  const answer = await fetch(`${scene.pictures}?${new URLSearchParams(pose)}`).catch(() => undefined);
  const found = await answer?.json().catch(() => undefined);
  const [near] = found?.pictures ?? [];
  taken.hidden = !near;
  if (!near) return (takenCaption.textContent = found?.detail ?? "The server does not answer; step on to ask again");
  taken.src = `${scene.pictures}/${near.sha256}`;
  const taken_ms = near.taken_ns / 1e6;
  const when = taken_ms > CLOCKS_BEGIN_MS ? `, ${new Date(taken_ms).toLocaleString()}` : "";
  takenCaption.textContent = `Taken ${near.distance_m.toFixed(1)} m away by the survey ${near.recording}${when}`;
}

function look(chosen) {
  from = chosen;
  const middle = box.getCenter(new THREE.Vector3()), size = box.getSize(new THREE.Vector3());
  const away = 1.3 * Math.max(size.x, size.y, 4) * Math.max(1, 1.6 / camera.aspect);
  controls.target.set(middle.x, middle.y, 1);
  camera.position.set(middle.x, middle.y - (from === "above" ? 0.01 : 0.5 * away), (from === "above" ? 0.7 : 0.42) * away);
  controls.update();
  draw();
}

function fit() {
  const { clientWidth, clientHeight } = canvas;
  if (!clientWidth || !clientHeight || !box) return;
  renderer.setPixelRatio(Math.min(2, devicePixelRatio));
  renderer.setSize(clientWidth, clientHeight, false);
  camera.aspect = clientWidth / clientHeight;
  if (isWalking()) camera.fov = (2 * Math.atan(scene.tangents[1])) / RAD;
  camera.updateProjectionMatrix();
  if (!isWalking() && from) look(from);
  draw();
}

function draw() {
  asked ??= requestAnimationFrame(() => {
    asked = undefined;
    nameRobots();
    renderer.render(world, camera);
    const px_per_m = canvas.clientHeight / (2 * Math.tan((camera.fov * RAD) / 2) * camera.position.distanceTo(controls.target));
    const shown_m = rounded(BAR_PX / px_per_m);
    bar.textContent = `${shown_m} m`;
    bar.style.width = `${shown_m * px_per_m}px`;
  });
}

// A canvas does not say what it shows.
element.onPage = (place) => {
  const on = new THREE.Vector3(...place).project(camera);
  return [(on.x + 1) / 2, (1 - on.y) / 2];
};
element.seen = () => {
  const told = ({ mark, robot }) => {
    const view = mark.children[2]?.geometry.getAttribute("position").array;
    return { ...robot, view: view && Array.from(view), page: element.onPage(mark.position) };
  };
  const loops = Object.fromEntries(["loops", "refused loops"].map((name, n) => [name, scene.loops.filter((loop) => loop[4] === 1 - n).length]));
  const surfels = groups.surfels.children.reduce((sum, cloud) => sum + cloud.geometry.getAttribute("position").count, 0);
  return { landmarks: exactness?.length ?? 0, surfels, loops, camera: camera.position.toArray(), robots: [...robots.values()].map(told) };
};

function listen() {
  let down;
  const plan = document.getElementById("plan");
  new ResizeObserver(fit).observe(canvas);
  controls.listenToKeyEvents(canvas);
  controls.addEventListener("change", draw);
  controls.addEventListener("start", () => (from = null));
  canvas.addEventListener("keydown", (event) => {
    const act = KEYS[event.key];
    if (!isWalking() || !act || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    ACTS[act]();
  });
  canvas.addEventListener("pointerdown", ({ offsetX, offsetY }) => (down = [offsetX, offsetY]));
  canvas.addEventListener("pointermove", (event) => {
    const found = event.buttons ? undefined : pointedAt(event);
    canvas.style.cursor = found === undefined ? "" : "pointer";
    canvas.title = found?.words ?? (found === undefined ? "" : `place ${found + 1}`);
  });
  canvas.addEventListener("click", (event) => {
    if (!down || Math.hypot(event.offsetX - down[0], event.offsetY - down[1]) > STILL_PX) return;
    if (measuring) return measure(event);
    const found = pointedAt(event);
    if (found?.address) location.assign(found.address);
    else if (found !== undefined) walkTo(found);
  });
  element.addEventListener("click", ({ target }) => ACTS[target.dataset.do]?.());
  element.addEventListener("change", ({ target }) => {
    if (target.name === "colour") paint();
    else if (groups[target.name]) (groups[target.name].visible = target.checked), draw();
  });
  plan.addEventListener("pick", ({ detail }) => walkTo(nearest(detail.x, detail.y)));
}

async function begin() {
  camera.up.set(0, 0, 1);
  element.style.setProperty("--aspect", scene.tangents[0] / scene.tangents[1]);
  for (const [name, group] of Object.entries(groups)) {
    group.visible = element.querySelector(`[name="${name}"]`)?.checked ?? name === "measured";
    world.add(group);
  }
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
  } catch {
    throw new Error("This browser draws nothing in three dimensions (WebGL is off); the map page shows the same from above.");
  }
  controls = new THREE.OrbitControls(camera, canvas);
  controls.maxPolarAngle = 0.495 * Math.PI;
  await fetchMap();
  drawMap();
  listen();
  fit();
  if (scene.surfels) drawSurfels().catch((error) => say(error.message, "bad"));
  follow("now", ({ marks }) => showRobots(marks));
  if (scene.start) walkTo(nearest(...scene.start));
}

begin().catch((error) => say(error.message, "bad"));
