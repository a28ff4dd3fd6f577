"use strict";
// Decides what is shown, and where. results.js and gestures.js change this state. scene.js draws it in 3D, but some
// browsers never load it.

const id = (name) => document.getElementById(name);
const data = JSON.parse(id("data").textContent);
const stage = id("stage");
const state = {
  view: data.start, mode: data.sources.length > 1 ? "swipe" : "blink", at: 0.5, solid: "", shape: "splats", frustums: "", background: data.background, pixels: "screen",
  order: "worst", overlay: 0, other: false, from: data.start, // `from` is the view before the step back
  atCamera: true, left: 0, right: 0, scheme: "",
  result: 0, zoom: 1, centre: [0.5, 0.5], // `centre` is the point of the stills in the middle, in shares of the picture
};
const BLINK = 700; // milliseconds that each side is shown
const SOFTWARE_MOST = 150000; // most Gaussians that are drawn without a GPU, where a frame takes 2 seconds
const PIXELS = 8; // pixels of the screen per pixel of a still, from which on these are drawn as squares
const QUIET = 1000; // milliseconds from the start of 3D to the measurement of its speed
const NARROW = 640; // on a stage of fewer pixels, sides are one above the other
let stills = null; // pictures of every source, for each view; the page's HTML has those that are seen first
let solid = null; // the 3D view, once it is loaded
let blinking = 0; // timer of the blinking
let chosen = false; // whether the reader has chosen stills or 3D

const clamp = (value, least, most) => Math.max(least, Math.min(most, value));
const view = () => data.views[state.view];
const inSolid = (source) => Boolean(state.solid && solid && solid.has(source));

const stillOf = (source) => (stills ? stills[state.view][source] : null);

// Returns whether a source can be seen from here. Once the camera has moved, only what is in 3D can be seen.
const isThere = (source) => inSolid(source) || (state.atCamera && (!stills || Boolean(stillOf(source))));

// Returns the source that a side shows: its own, or the other side's if its own cannot be seen from here.
function shownAt(side) {
  const [own, other] = side === "left" ? [state.left, state.right] : [state.right, state.left];
  return isThere(own) || !isThere(other) ? own : other;
}

// Returns the sides that are seen, and their boxes in shares of the stage from its top left corner.
function panes() {
  const whole = [0, 0, 1, 1];
  const [left, right, at] = [shownAt("left"), shownAt("right"), state.at];
  if (state.mode === "side") {
    const boxes = stage.classList.contains("stacked") ? [[0, 0, 1, 0.5], [0, 0.5, 1, 0.5]] : [[0, 0, 0.5, 1], [0.5, 0, 0.5, 1]];
    return [left, right].map((source, i) => ({ source, box: boxes[i], clip: boxes[i] }));
  }
  if (state.mode === "blink" || state.other) {
    return [{ source: state.other ? right : left, box: whole, clip: whole }];
  }
  const clips = state.mode === "swipe" ? [[0, 0, at, 1], [at, 0, 1 - at, 1]] : [whole, whole];
  return [left, right].map((source, i) => ({ source, box: whole, clip: clips[i] }));
}

function frame() {
  const box = stage.getBoundingClientRect();
  const scale = window.devicePixelRatio || 1;
  let [width, height] = [box.width * scale, box.height * scale];
  if (state.pixels === "photo") {
    const side = state.mode === "side";
    const stacked = stage.classList.contains("stacked");
    [width, height] = [view().width * (side && !stacked ? 2 : 1), view().height * (side && stacked ? 2 : 1)];
  }
  const { background, shape } = state;
  return {
    width: Math.round(width), height: Math.round(height), panes: panes(), difference: state.mode === "difference" && !state.other,
    background, shape, frustums: Boolean(state.frustums), shown: Boolean(state.solid), exact: state.pixels === "photo",
  };
}

// Makes the stage as large as the window allows, so that its lower edge is seen without scrolling.
function fitStage() {
  const { width, height } = view();
  const side = state.mode === "side";
  stage.classList.toggle("stacked", side && stage.parentElement.clientWidth < NARROW && width > height);
  const stacked = stage.classList.contains("stacked");
  const above = stage.getBoundingClientRect().top + (document.fullscreenElement ? 0 : window.scrollY);
  stage.style.setProperty("--ratio", ((side && !stacked ? 2 : 1) * width) / ((stacked ? 2 : 1) * height));
  stage.style.setProperty("--above", `${Math.ceil(above)}px`);
}

// Shows the zoom of stills; in 3D the camera comes nearer instead.
function showZoom() {
  const zoom = state.solid ? 1 : state.zoom;
  const [x, y] = state.centre.map((at) => `${100 * (0.5 - zoom * at)}%`);
  const pane = panes()[0].box[2] * stage.clientWidth;
  stage.classList.toggle("zoomed", zoom > 1);
  stage.classList.toggle("squares", (zoom * pane) / view().width >= PIXELS);
  for (const [name, value] of [["--x", x], ["--y", y], ["--zoom", zoom]]) stage.style.setProperty(name, value);
  id("back").hidden = state.atCamera && zoom === 1;
  id("back").textContent = state.atCamera ? `${zoom.toFixed(1)} × · whole picture` : "Back to the view";
}

// Lays a photo over a side, with an opacity.
function lay(layer, address, opacity) {
  layer.hidden = !address || opacity === 0;
  if (layer.hidden) return;
  const key = String(state.view);
  if (layer.dataset.shown !== key) layer.style.backgroundImage = `url("${address}")`;
  layer.dataset.shown = key;
  layer.style.opacity = opacity;
}

function show() {
  stage.dataset.mode = state.other && state.mode !== "side" ? "blink" : state.mode;
  stage.classList.toggle("solid", Boolean(state.solid));
  stage.style.setProperty("--at", `${100 * state.at}%`);
  fitStage();
  showZoom();
  const seen = panes().map((pane) => pane.source);
  const [left, right] = [shownAt("left"), shownAt("right")];
  const twice = left === right;
  const missing = [];
  const plain = state.atCamera && state.mode !== "difference";
  for (const side of ["left", "right"]) {
    const source = side === "left" ? left : right;
    const here = seen.includes(source) && !(twice && seen.length === 1 && side === "right");
    const drawn = inSolid(source);
    const still = stillOf(source);
    const picture = id(side);
    picture.hidden = !here || drawn || !state.atCamera || (stills && !still);
    if (!picture.hidden && still && picture.src !== still) picture.src = still;
    picture.alt = `${roleOf(source)}: ${view().name}`;
    const pane = id(`${side}-pane`);
    pane.hidden = !here;
    lay(pane.querySelector(".overlay"), data.photos && plain && stillOf(0), state.overlay);
    const tag = id(`${side}-tag`);
    tag.hidden = !here;
    tag.textContent = data.sources[source].name;
    if (here && (source !== state[side] || !isThere(source))) missing.push(data.sources[state[side]].name);
  }
  id("message").hidden = missing.length === 0;
  id("message").textContent = `${[...new Set(missing)].join(" and ")}: at the photos' cameras only`;
  id("handle").hidden = stage.dataset.mode !== "swipe";
  id("handle").setAttribute("aria-valuenow", Math.round(100 * state.at));
  for (const button of document.querySelectorAll("[data-set]")) {
    button.setAttribute("aria-pressed", String(String(state[button.dataset.set]) === button.dataset.value));
  }
  id("outside").setAttribute("aria-pressed", String(view().outside));
  showLimits();
  if (solid && state.solid) solid.request();
}

// Greys out controls that have no effect now, with the reason; hides the controls of 3D unless 3D is shown.
function showLimits() {
  const away = !state.atCamera ? "From a view's camera only: press R" : state.mode === "difference" ? "Not over a difference" : "";
  const none = solid ? "" : id("status").textContent || "3D is not there yet";
  const outside = view().outside ? "From a photo's camera only" : "";
  for (const field of document.querySelectorAll(".in-3d")) field.hidden = !state.solid;
  for (const button of document.querySelectorAll("[data-set]")) {
    const { set: name, value } = button.dataset;
    grey(button, name === "solid" && value ? none : "");
  }
  if (id("overlay-share")) grey(id("overlay-share"), outside || away);
  id("full").hidden = !document.fullscreenEnabled;
}

function grey(control, reason) {
  control.disabled = Boolean(reason);
  control.title = reason || "";
}

// Moves to exactly the camera of a view.
function jump(index) {
  state.view = clamp(index, 0, data.views.length - 1);
  state.atCamera = true;
  for (const card of id("strip").children) {
    const current = Number(card.dataset.view) === state.view;
    card.setAttribute("aria-current", String(current));
    if (current && stills) {
      const strip = id("strip").getBoundingClientRect();
      const box = card.getBoundingClientRect();
      if (box.left < strip.left || box.right > strip.right) id("strip").scrollLeft += box.left - strip.left - (strip.width - box.width) / 2;
    }
  }
  if (solid) solid.look(state.view);
  showNumbers();
  show();
}

// Moves to the view from outside the capture, or back to the view before.
function stepBack() {
  if (!view().outside) state.from = state.view;
  zoomTo(1);
  jump(view().outside ? state.from : data.views.findIndex((one) => one.outside));
}

function set(name, value) {
  state[name] = value;
  if (name === "solid") chosen = true;
  if (name === "mode") state.other = false;
  if (name === "order") orderStrip();
  if (name === "scheme") document.documentElement.className = value;
  if (name === "left" || name === "right") {
    const result = [state.right, state.left].find((source) => source >= FIRST_RESULT);
    if (result !== undefined && result !== state.result) showResult(result);
    if (solid) load(solid).then(show).then(measureSpeed);
  }
  show();
}

function swipeTo(share) {
  state.at = clamp(share, 0, 1);
  show();
}

function toggleFull() {
  if (document.fullscreenElement) document.exitFullscreen();
  else if (document.fullscreenEnabled) stage.parentElement.requestFullscreen().catch((error) => say(error.message));
}

// Fills the strip of views, once the stills are loaded.
function startStrip() {
  stills = JSON.parse(id("stills").textContent);
  stills[data.start] = stills[data.start].map((still, source) => still || inPage.get(source) || null);
  const shown = Number(!data.photos && data.sources.length > 1); // without photos, cards show the result and not the input
  for (const card of id("strip").children) {
    const still = stills[card.dataset.view].find((one, i) => one && i >= shown);
    if (still) card.querySelector("img").src = still;
  }
  jump(data.start);
}

function say(words) {
  id("status").textContent = words;
  showLimits();
}

// Loads the Gaussians that the sides show into 3D; without a GPU, only small scenes.
async function load(made) {
  for (const source of [state.left, state.right]) {
    const { splats, count, antialiased } = data.sources[source];
    const drawable = splats && !(made.software && count > SOFTWARE_MOST);
    if (!drawable || made.has(source) || !id(splats)) continue;
    await made.add(source, await unpackSplats(takeBytes(splats)), undefined, antialiased);
  }
}

async function startScene() {
  const probe = document.createElement("canvas");
  if (!id("engine")) return say("Stills only: this page holds no Gaussians");
  if (!window.DecompressionStream || !probe.getContext("webgl2")) return say("Stills only: this browser has no WebGL 2");
  say("3D loads …");
  const painted = () => new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
  await painted().then(painted); // so that the first still appears before 3D is loaded
  try {
    await loadVendor(takeBytes("engine"));
    const moved = () => {
      if (state.atCamera) {
        state.atCamera = false;
        show();
      }
    };
    const settle = (settled) => stage.setAttribute("aria-busy", String(!settled));
    const made = new SplatView(id("canvas"), data.views, frame, moved, settle);
    made.look(state.view);
    await load(made);
    if (!made.software) await made.prepare();
    solid = made;
    if (solid.current !== state.view) solid.look(state.view);
    id("canvas").addEventListener("webglcontextlost", () => {
      [solid, state.solid] = [null, ""];
      jump(state.view);
      say("3D was lost: reload the page");
    });
    if (!chosen && !solid.software) state.solid = "1";
    say(solid.software ? "no GPU: 3D is slow and coarse, and shows small scenes only" : "");
    show();
    setTimeout(measureSpeed, QUIET);
  } catch (error) {
    [solid, state.solid] = [null, ""];
    say(`Stills only: ${error.message}`);
    show();
  }
}

const inPage = new Map();

function start() {
  for (const side of ["left", "right"]) {
    state[side] = Number(id(`${side}-source`).value);
    inPage.set(state[side], id(side).getAttribute("src"));
  }
  state.result = Math.max(state.right, FIRST_RESULT);
  listen();
  show();
  showNumbers();
  markResult();
}
