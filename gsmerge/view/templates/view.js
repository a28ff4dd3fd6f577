"use strict";
// Controls and stills. 3D (scene.js) is asked to draw what they say, and may never come.

const id = (name) => document.getElementById(name);
const data = JSON.parse(id("data").textContent);
const stage = id("stage");
const state = {
  view: data.start, mode: data.sources.length > 1 ? "swipe" : "blink", at: 0.5, solid: "", shape: "splats", frustums: "", background: "#000000", pixels: "screen",
  order: "worst", overlay: 0, outlines: "", other: false, atCamera: true, left: 0, right: 0,
};
const KEYS = { 1: "swipe", 2: "side", 3: "blink", 4: "difference" };
const BLINK = 700; // milliseconds
const SOFTWARE_MOST = 150000; // Gaussians: 2 seconds a frame on a processor
const [LOW, HIGH, FULL] = ["62vh", "max(62vh, 100vh - 12rem)", "100vh - 3.6rem"]; // most height: wide, upright, full screen
const NARROW = 640; // pixels of the stage, below which sides go one above the other
let stills = null; // per view the pictures of every source; those that are seen first are in the page itself
let outlines = []; // per view the borders of its superpixels, where there are any
let solid = null; // the 3D view, once it is there
let blinking = 0; // the timer
let chosen = false; // whether the reader has chosen stills or 3D

const view = () => data.views[state.view];
const inSolid = (source) => Boolean(state.solid && solid && solid.has(source));

function stillOf(source) {
  return stills ? stills[state.view][source] : null;
}

// Which of the sides are seen, and where: shares of the stage from its top left corner.
function panes() {
  const whole = [0, 0, 1, 1];
  const { left, right, at } = state;
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

function fitStage() {
  const { width, height } = view();
  const side = state.mode === "side";
  stage.classList.toggle("stacked", side && stage.parentElement.clientWidth < NARROW && width > height);
  const stacked = stage.classList.contains("stacked");
  const ratio = ((side && !stacked ? 2 : 1) * width) / ((stacked ? 2 : 1) * height);
  stage.style.aspectRatio = String(ratio);
  const most = document.fullscreenElement ? FULL : ratio < 1 ? HIGH : LOW;
  stage.style.maxWidth = `calc((${most}) * ${ratio.toFixed(4)})`;
}

function show() {
  stage.dataset.mode = state.other && state.mode !== "side" ? "blink" : state.mode;
  stage.classList.toggle("solid", Boolean(state.solid));
  stage.style.setProperty("--at", `${100 * state.at}%`);
  fitStage();
  const seen = panes().map((pane) => pane.source);
  const twice = state.left === state.right;
  const missing = [];
  for (const side of ["left", "right"]) {
    const source = state[side];
    const here = seen.includes(source) && !(twice && seen.length === 1 && side === "right");
    const drawn = inSolid(source);
    const still = stillOf(source);
    const picture = id(side);
    picture.hidden = !here || drawn || !state.atCamera || (stills && !still);
    if (!picture.hidden && still && picture.src !== still) picture.src = still;
    picture.alt = data.sources[source].name;
    const tag = id(`${side}-tag`);
    tag.hidden = !here;
    tag.textContent = data.sources[source].name;
    if (here && !drawn && ((state.solid && !state.atCamera) || (stills && !still))) missing.push(data.sources[source].name);
  }
  id("message").hidden = missing.length === 0;
  id("message").textContent = `${[...new Set(missing)].join(" and ")}: at the photos' cameras only`;
  id("handle").hidden = stage.dataset.mode !== "swipe";
  id("handle").setAttribute("aria-valuenow", Math.round(100 * state.at));
  id("back").hidden = state.atCamera;
  const photo = data.photos && stillOf(0);
  id("overlay").hidden = !photo || !state.atCamera || state.overlay === 0;
  if (!id("overlay").hidden) id("overlay").style.backgroundImage = `url("${photo}")`;
  id("overlay").style.opacity = state.overlay;
  const outline = outlines[state.view];
  id("outlines").hidden = !outline || !state.atCamera || !state.outlines;
  if (!id("outlines").hidden) id("outlines").style.backgroundImage = `url("${outline}")`;
  for (const button of document.querySelectorAll("[data-set]")) {
    button.setAttribute("aria-pressed", String(String(state[button.dataset.set]) === button.dataset.value));
  }
  showLimits();
  if (solid && state.solid) solid.request();
}

// Greys out what has no effect now, and says why.
function showLimits() {
  const away = state.atCamera ? "" : "From the photo's camera only: press R";
  const none = solid ? "" : id("status").textContent || "3D is not there yet";
  const flat = state.solid ? "" : none || "In 3D only";
  const outside = view().outside ? "No photo is outside" : "";
  const bare = outlines[state.view] ? "" : outside || (view().held_out ? "Held-out photos have no superpixels" : "Not there yet");
  const reasons = { shape: flat, frustums: flat, background: flat, pixels: flat, outlines: bare || away };
  for (const button of document.querySelectorAll("[data-set]")) {
    const { set: name, value } = button.dataset;
    grey(button, name === "solid" && value ? none : reasons[name]);
  }
  if (id("overlay-share")) grey(id("overlay-share"), outside || away);
  grey(id("full"), document.fullscreenEnabled ? "" : "This browser has no full screen");
}

function grey(control, reason) {
  control.disabled = Boolean(reason);
  control.title = reason || "";
}

function showNumbers() {
  const named = view();
  const badge = document.createElement("em");
  badge.className = "badge";
  badge.textContent = named.held_out ? "held out" : "from outside";
  id("view-name").replaceChildren(`${named.name} `, ...(named.held_out || named.outside ? [badge] : []));
  const rows = named.scores.map(([psnr, ssim], i) => {
    const row = document.createElement("tr");
    const cells = [data.sources[i + Number(data.photos)].name, psnr === null ? "-" : psnr.toFixed(2), ssim === null ? "-" : ssim.toFixed(3)];
    row.append(...cells.map((words) => {
      const cell = document.createElement("td");
      cell.textContent = words;
      cell.title = words;
      return cell;
    }));
    return row;
  });
  id("scores").replaceChildren(...rows);
}

// To the camera of a view, exactly.
function jump(index) {
  state.view = Math.max(0, Math.min(data.views.length - 1, index));
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

function stepBack() {
  jump(data.views.findIndex((one) => one.outside));
}

// The view that many cards further along the strip.
function step(count) {
  const cards = [...id("strip").children].sort((a, b) => a.style.order - b.style.order);
  const at = cards.findIndex((card) => Number(card.dataset.view) === state.view);
  const next = cards[Math.max(0, Math.min(cards.length - 1, at + count))];
  jump(Number(next.dataset.view));
}

function set(name, value) {
  state[name] = value;
  if (name === "solid") chosen = true;
  if (name === "mode") state.other = false;
  if (name === "order") for (const card of id("strip").children) card.style.order = value === "worst" ? card.dataset.view : card.dataset.place;
  if (solid && (name === "left" || name === "right")) load(solid).then(show);
  show();
}

const toggled = { solid: ["", "1"], shape: ["splats", "points"], frustums: ["", "1"] };
function toggle(name) {
  if (name === "solid" ? solid : state.solid) set(name, toggled[name][1 - toggled[name].indexOf(state[name])]);
}

function swipeTo(share) {
  state.at = Math.max(0, Math.min(1, share));
  show();
}

function toggleFull() {
  if (document.fullscreenElement) document.exitFullscreen();
  else if (document.fullscreenEnabled) stage.parentElement.requestFullscreen().catch((error) => say(error.message));
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName)) return;
  const key = event.key.toLowerCase();
  const actions = {
    arrowleft: () => swipeTo(state.at - 0.02), arrowright: () => swipeTo(state.at + 0.02),
    home: () => swipeTo(0), end: () => swipeTo(1), arrowup: () => step(-1), arrowdown: () => step(1),
    b: stepBack, f: toggleFull, o: () => set("outlines", state.outlines ? "" : "1"), s: () => toggle("solid"), p: () => toggle("shape"), c: () => toggle("frustums"), r: () => jump(state.view),
    " ": () => { state.other = true; show(); },
  };
  if (KEYS[key] && data.sources.length > 1) set("mode", KEYS[key]);
  else if (actions[key] && !(key === " " && event.target.tagName === "BUTTON")) actions[key]();
  else return;
  event.preventDefault();
}

function listen() {
  document.addEventListener("keydown", onKey);
  document.addEventListener("keyup", (event) => {
    if (event.key === " " && state.other && state.mode !== "blink") set("other", false);
  });
  document.addEventListener("click", (event) => {
    const button = event.target.closest("[data-set]");
    const card = event.target.closest("[data-view]");
    if (button) set(button.dataset.set, button.dataset.value);
    if (card) jump(Number(card.dataset.view));
  });
  for (const side of ["left", "right"]) id(`${side}-source`).addEventListener("input", (event) => set(side, Number(event.target.value)));
  if (id("overlay-share")) id("overlay-share").addEventListener("input", (event) => set("overlay", event.target.value / 100));
  id("back").addEventListener("click", () => jump(state.view));
  id("outside").addEventListener("click", stepBack);
  id("full").addEventListener("click", toggleFull);
  document.addEventListener("fullscreenchange", () => {
    id("full").textContent = document.fullscreenElement ? "Leave full screen" : "Full screen";
    show();
  });
  window.addEventListener("resize", show);
  const still = window.matchMedia("(prefers-reduced-motion: reduce)");
  blinking = setInterval(() => {
    if (state.mode === "blink" && !still.matches && !document.hidden) set("other", !state.other);
  }, BLINK);
  listenToPointers();
}

// Handle, or anywhere in stills: the swipe. Elsewhere in 3D: one finger turns, two shift and zoom.
function listenToPointers() {
  const pointers = new Map();
  let swiping = false;
  const toShare = (event) => {
    const box = stage.getBoundingClientRect();
    return (event.clientX - box.left) / box.width;
  };
  stage.addEventListener("pointerdown", (event) => {
    if (event.target === id("back")) return;
    pointers.set(event.pointerId, event);
    stage.setPointerCapture(event.pointerId);
    swiping = stage.dataset.mode === "swipe" && (event.target === id("handle") || !state.solid);
    if (swiping) swipeTo(toShare(event));
  });
  stage.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    pointers.set(event.pointerId, event);
    if (swiping) swipeTo(toShare(event));
    else if (state.solid) drag(last, event, [...pointers.values()].find((one) => one.pointerId !== event.pointerId));
  });
  for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, (event) => pointers.delete(event.pointerId));
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("wheel", (event) => {
    if (!state.solid) return;
    event.preventDefault();
    solid.dolly(Math.exp(0.0012 * Math.max(-240, Math.min(240, event.deltaY))));
  }, { passive: false });
}

function drag(last, event, other) {
  const box = stage.getBoundingClientRect();
  const [dx, dy] = [(event.clientX - last.clientX) / box.width, (event.clientY - last.clientY) / box.height];
  if (other) {
    const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) || 1;
    solid.dolly(apart(last) / apart(event));
    solid.pan(dx / 2, dy / 2);
  } else if (event.shiftKey || event.buttons & 6) solid.pan(dx, dy);
  else solid.orbit(-3 * dx, -3 * dy * (box.height / box.width));
}

// The strip, when the stills have come.
function startStrip() {
  stills = JSON.parse(id("stills").textContent);
  outlines = JSON.parse(id("outline-pictures").textContent);
  stills[data.start] = stills[data.start].map((still, source) => still || inPage.get(source) || null);
  const shown = Number(!data.photos && data.sources.length > 1); // without photos the result, not its reference
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

// Takes in what the sides show; without a GPU nothing that would take minutes for a frame.
async function load(made) {
  for (const source of [state.left, state.right]) {
    const { splats, count } = data.sources[source];
    const drawable = splats && !(made.software && count > SOFTWARE_MOST);
    if (drawable && !made.has(source) && id(splats)) await made.add(source, takeBytes(splats));
  }
}

async function startScene() {
  const probe = document.createElement("canvas");
  if (!id("engine")) return say("Stills only: too many Gaussians for a page");
  if (!window.DecompressionStream || !probe.getContext("webgl2")) return say("Stills only: this browser has no WebGL 2");
  say("3D loads …");
  const painted = () => new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
  await painted().then(painted); // the first still comes first
  try {
    await loadVendor();
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
  } catch (error) {
    [solid, state.solid] = [null, ""];
    say(`Stills only: ${error.message}`);
    show();
  }
}

[state.left, state.right] = ["left", "right"].map((side) => Number(id(`${side}-source`).value));
const inPage = new Map(["left", "right"].map((side) => [state[side], id(side).getAttribute("src")]));
listen();
fitStage();
showNumbers();
