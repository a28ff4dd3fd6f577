"use strict";
// The page of a published scene, which contains all files. The camera stays near the places of the photos.

const id = (name) => document.getElementById(name);
const data = JSON.parse(id("data").textContent);
const stage = id("stage");
const [SCENE, VR] = ["scene", "immersive-vr"];
const METRES = 2; // distance of the target in VR
// In distances of the photos' cameras from their targets: how far the camera may be outside the hull of these cameras, how
// far its target may be outside the hull of their targets, and how near the camera may come to its target
const [AROUND, BESIDE, NEAREST] = [0.1, 0.15, 0.25];
const MOST_LENS = 5; // largest factor on the focal length, which grows when the camera can come no nearer
const DIRECTIONS = [-1, 0, 1].flatMap((x) => [-1, 0, 1].flatMap((y) => [-1, 0, 1].map((z) => [x, y, z]))).filter((one) => one.some(Boolean));
const ROUNDS = 12; // rounds over all half spaces of a hull to bring a point into them
const [TURN, KEY_TURN, KEY_FACTOR, STRIDE, WHEEL] = [2.5, 0.06, 1.15, 0.04, 0.0015];
const WALKS = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] }; // direction by key: right, up, ahead
let site = null; // the 3D view, once it is there

// Returns the half spaces that contain points and a margin around them. Each is a direction and the largest coordinate
// along it.
function hullOf(points, margin) {
  const vectors = DIRECTIONS.map((one) => new Vendor.Vector3(...one).normalize());
  return vectors.map((along) => [along, margin + Math.max(...points.map((point) => point.dot(along)))]);
}

// Moves a point into a hull; returns true if it was outside.
function pullInto(hull, point) {
  let moved = false;
  for (let round = 0; round < ROUNDS; round++) {
    for (const [along, most] of hull) {
      const over = point.dot(along) - most;
      if (over > 1e-9 * Math.abs(most)) [moved, point] = [true, point.addScaledVector(along, -over)];
    }
  }
  return moved;
}

class SiteView extends SplatView {
  constructor(canvas, views, frame, onSettle) {
    super(canvas, views, frame, () => {}, onSettle);
    const distances = views.map((view) => view.distance).sort((a, b) => a - b);
    const middle = distances[distances.length >> 1];
    [this.camera.near, this.camera.far] = [0.01 * middle, 1000 * middle];
    this.nearest = NEAREST * distances[0];
    this.places = hullOf(this.poses.map((pose) => column(pose, 3)), AROUND * middle);
    this.targets = hullOf(this.poses.map((pose, i) => column(pose, 3).addScaledVector(column(pose, 2), -views[i].distance)), BESIDE * middle);
    this.reset();
  }

  reset() {
    this.lens = 1;
    this.look(data.start);
    this.moved();
  }

  // Chooses the focal length with which the picture of the first camera covers the stage.
  fit() {
    const first = this.views[data.start];
    const { width, height } = this.frame();
    const scale = Math.max(width / first.width, height / first.height) * this.lens;
    this.view = { ...first, width, height, K: [first.K[0] * scale, first.K[1] * scale, width / 2, height / 2] };
    this.changed();
  }

  // Moves camera and target to places that are allowed, and makes the camera look at the target, with the scene's up.
  moved() {
    const place = column(this.camera.matrix, 3);
    if (!data.free) {
      pullInto(this.targets, this.target);
      const away = place.clone().sub(this.target);
      if (away.length() < this.nearest) place.copy(this.target).addScaledVector(away.normalize(), this.nearest);
      pullInto(this.places, place);
    }
    const back = place.clone().sub(this.target).normalize();
    const right = this.up.clone().cross(back);
    if (right.length() > 0.05) {
      right.normalize();
      const up = back.clone().cross(right);
      this.camera.matrix.set(right.x, up.x, back.x, place.x, right.y, up.y, back.y, place.y, right.z, up.z, back.z, place.z, 0, 0, 0, 1);
    }
    super.moved();
    this.fit();
  }

  // Comes nearer by a factor. The camera moves as far as it may, and the focal length does the rest.
  nearer(factor) {
    if (factor < 1 && this.lens > 1) {
      const lens = Math.max(1, this.lens * factor);
      [factor, this.lens] = [(factor * this.lens) / lens, lens];
    }
    const distance = () => column(this.camera.matrix, 3).distanceTo(this.target);
    const before = distance();
    this.dolly(factor < 1 ? Math.min(1 / factor, this.farthest()) : 1 / factor);
    if (factor > 1) this.lens = Math.min(MOST_LENS, Math.max(this.lens, (this.lens * factor * distance()) / before));
    this.fit();
  }

  // Returns how many times its distance from the target the camera may have, straight back. At larger distances it would
  // leave the hull, and be pulled to the side.
  farthest() {
    if (data.free) return Infinity;
    const place = column(this.camera.matrix, 3);
    const back = place.clone().sub(this.target);
    const steps = this.places.map(([along, most]) => (back.dot(along) > 0 ? (most - place.dot(along)) / back.dot(along) : Infinity));
    return 1 + Math.max(0, Math.min(...steps));
  }

  request() {
    if (!this.renderer.xr.isPresenting) super.request(); // a headset requests frames itself
  }

  // Shows the scene in a headset. Its wearer stands upright at the camera's place, with the target a few metres ahead.
  async enter() {
    const session = await navigator.xr.requestSession(VR);
    const { scene, mesh, spark } = this.results.get(SCENE);
    const place = column(this.camera.matrix, 3);
    const back = column(this.camera.matrix, 0).cross(this.up).normalize();
    const right = this.up.clone().cross(back);
    const scale = METRES / place.distanceTo(this.target);
    const rows = [right, this.up, back].flatMap((axis) => [...axis.clone().multiplyScalar(scale).toArray(), -scale * axis.dot(place)]);
    mesh.matrixAutoUpdate = false;
    mesh.matrix.set(...rows, 0, 0, 0, 1);
    this.renderer.xr.enabled = spark.autoUpdate = true;
    session.addEventListener("end", () => {
      mesh.matrix.identity();
      this.renderer.xr.enabled = spark.autoUpdate = false;
      this.renderer.setAnimationLoop(null);
      setTimeout(() => this.changed());
    });
    this.renderer.xr.setReferenceSpaceType("local");
    this.renderer.setScissorTest(false);
    await this.renderer.xr.setSession(session);
    const head = new Vendor.PerspectiveCamera();
    this.renderer.setAnimationLoop(() => this.renderer.render(scene, head));
  }
}

function frame() {
  const box = stage.getBoundingClientRect();
  const scale = Math.min(2, window.devicePixelRatio || 1);
  const whole = [0, 0, 1, 1];
  const [width, height] = [box.width, box.height].map((side) => Math.max(1, Math.round(side * scale)));
  return {
    width, height, panes: [{ source: SCENE, box: whole, clip: whole }], background: "#000000", shape: "splats", shown: true,
  };
}

const say = (words) => { id("status").textContent = words; };

async function start() {
  say("3D loads …");
  listen();
  id("full").hidden = !document.fullscreenEnabled;
  try {
    const scene = takeBytes(data.names.scene);
    [id("save").href, id("save").hidden] = [URL.createObjectURL(new Blob([scene])), false];
    if (!window.DecompressionStream || !document.createElement("canvas").getContext("webgl2")) throw new Error("this browser has no WebGL 2");
    await loadVendor(takeBytes(data.names.engine));
    const settle = (settled) => stage.setAttribute("aria-busy", String(!settled));
    const made = new SiteView(id("canvas"), data.views, frame, settle);
    await made.add(SCENE, scene, data.names.scene);
    await made.prepare();
    site = made;
    [id("canvas").hidden, id("poster").hidden, id("reset").hidden] = [false, true, false];
    id("canvas").addEventListener("webglcontextlost", () => say("3D was lost: reload the page"));
    say("");
    site.fit();
    if (navigator.xr) id("headset").hidden = !(await navigator.xr.isSessionSupported(VR));
  } catch (error) {
    say(`No 3D: ${error.message}`);
  }
}

function listen() {
  const pointers = new Map();
  const apart = (one, other) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) || 1;
  stage.addEventListener("pointerdown", (event) => {
    pointers.set(event.pointerId, event);
    stage.setPointerCapture(event.pointerId);
  });
  stage.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last || !site) return;
    pointers.set(event.pointerId, event);
    const other = [...pointers.values()].find((one) => one.pointerId !== event.pointerId);
    const [dx, dy] = [(event.clientX - last.clientX) / stage.clientWidth, (event.clientY - last.clientY) / stage.clientHeight];
    if (other) {
      site.nearer(apart(event, other) / apart(last, other));
      site.pan(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 6) site.pan(dx, dy);
    else site.orbit((-TURN * dx) / site.lens, (-TURN * dy * stage.clientHeight) / stage.clientWidth / site.lens);
  });
  for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, (event) => pointers.delete(event.pointerId));
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (site) site.nearer(Math.exp(-WHEEL * Math.max(-240, Math.min(240, event.deltaY * (event.deltaMode ? 33 : 1)))));
  }, { passive: false });
  document.addEventListener("keydown", onKey);
  window.addEventListener("resize", () => site && site.fit());
  id("reset").addEventListener("click", () => site.reset());
  id("full").addEventListener("click", () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen()));
  id("headset").addEventListener("click", () => site.enter().catch((error) => say(`No VR: ${error.message}`)));
}

function onKey(event) {
  if (!site || event.ctrlKey || event.metaKey || event.altKey) return;
  const key = event.key.toLowerCase();
  const walk = WALKS[event.code.replace("Key", "").toLowerCase()];
  const actions = {
    arrowleft: () => site.orbit(-KEY_TURN, 0), arrowright: () => site.orbit(KEY_TURN, 0), arrowup: () => site.orbit(0, -KEY_TURN),
    arrowdown: () => site.orbit(0, KEY_TURN), "+": () => site.nearer(KEY_FACTOR), "=": () => site.nearer(KEY_FACTOR),
    "-": () => site.nearer(1 / KEY_FACTOR), r: () => site.reset(),
  };
  if (walk) site.fly(...walk.map((by) => STRIDE * by));
  else if (actions[key]) actions[key]();
  else return;
  event.preventDefault();
}
