"use strict";
// Keys, pointers and wheel: they swipe and zoom stills, and turn and move the camera in 3D.

const MODES = { 1: "swipe", 2: "side", 3: "blink", 4: "difference" };
const TOGGLED = { solid: ["", "1"], shape: ["splats", "points"], frustums: ["", "1"] };
const FLIGHT = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] }; // direction by key: right, up, ahead
const SPEED = 0.5; // flight in a second, in distances of the target
const [MOST_ZOOM, CLICK_ZOOM, KEY_ZOOM] = [16, 3, 1.25];
const WHEEL = 0.0015; // change of the logarithm of the zoom for each pixel of the wheel
const LINE = 33; // pixels of the wheel in a line of it
const PINCH = 6; // factor on the pixels of the wheel when two fingers zoom on a touchpad
const TWICE = 500; // longest time of a double click, milliseconds
const flying = new Set(); // keys of the flight that are down
let haste = 1; // factor on the speed

// Enlarges stills. The point at a place of a pane, which is given in shares of it, does not move.
function zoomTo(scale, place = [0.5, 0.5]) {
  const zoom = clamp(scale, 1, MOST_ZOOM);
  const centre = state.centre.map((at, i) => at + (place[i] - 0.5) * (1 / state.zoom - 1 / zoom));
  state.zoom = zoom;
  centreOn(centre);
}

// Shifts stills by shares of a pane.
function shift(dx, dy) {
  centreOn([state.centre[0] - dx / state.zoom, state.centre[1] - dy / state.zoom]);
}

function centreOn(centre) {
  state.centre = centre.map((at) => clamp(at, 0.5 / state.zoom, 1 - 0.5 / state.zoom));
  showZoom();
}

// Returns the source of the pane below a pointer, the pane's size, and the place of the pointer in shares of the pane.
function paneAt({ clientX, clientY }) {
  const stageBox = stage.getBoundingClientRect();
  const [x, y] = [(clientX - stageBox.left) / stageBox.width, (clientY - stageBox.top) / stageBox.height];
  const all = panes();
  const covers = ({ clip: [left, top, width, height] }) => x >= left && x <= left + width && y >= top && y <= top + height;
  const pane = all.find(covers) || all[0];
  const [left, top, width, height] = pane.box;
  return { source: pane.source, place: [(x - left) / width, (y - top) / height], width: width * stageBox.width, height: height * stageBox.height };
}

const isGrey = (name, value) => [...document.querySelectorAll(`[data-set="${name}"]`)].some((one) => one.dataset.value === value && one.disabled);

function toggle(name) {
  const inSolidOnly = name === "shape" || name === "frustums";
  const values = TOGGLED[name];
  const after = values.map((_, i) => values[(values.indexOf(state[name]) + 1 + i) % values.length]);
  const next = after.find((value) => value === "" || !isGrey(name, value)); // "" (off) is always possible
  if (name === "solid" ? solid : !inSolidOnly || state.solid) set(name, next === undefined ? state[name] : next);
}

function nearer(factor) {
  if (state.solid) solid.dolly(1 / factor);
  else zoomTo(state.zoom * factor);
}

function reset() {
  zoomTo(1);
  jump(view().outside ? state.from : state.view);
}

function frameScene() {
  const source = [state.right, state.left].find((one) => inSolid(one));
  if (source !== undefined) solid.frameAll(source);
}

// Makes the point that is seen below the pointer the target, about which the camera then turns.
function turnAbout(event) {
  const { source, place } = paneAt(event);
  const drawn = [source, state.right, state.left].find((one) => inSolid(one));
  const point = drawn === undefined ? null : solid.pointAt(drawn, ...place);
  if (!point) return;
  solid.target = point;
  const box = stage.getBoundingClientRect();
  const mark = id("pivot");
  [mark.style.left, mark.style.top] = [`${event.clientX - box.left}px`, `${event.clientY - box.top}px`];
  mark.hidden = false;
  setTimeout(() => (mark.hidden = true), 2 * TWICE);
}

function fly(last) {
  requestAnimationFrame((now) => {
    if (!flying.size || !state.solid) return flying.clear();
    const stride = SPEED * Math.min(0.1, (now - last) / 1000);
    const directions = [...flying].map((key) => FLIGHT[key]);
    solid.fly(...[0, 1, 2].map((axis) => haste * stride * directions.reduce((sum, one) => sum + one[axis], 0)));
    fly(now);
  });
}

function takeOff(key, fast) {
  haste = fast ? 3 : 1;
  if (flying.size === 0) fly(performance.now());
  flying.add(key);
}

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName)) return;
  const key = event.key.toLowerCase();
  const letter = event.code.replace("Key", "").toLowerCase(); // by place, so that other keyboards have the keys of W, A, S and D
  const arrow = (dx, dy, otherwise) => () => (event.shiftKey && !state.solid ? shift(0.1 * dx, 0.1 * dy) : otherwise());
  const actions = {
    arrowleft: arrow(1, 0, () => swipeTo(state.at - 0.02)), arrowright: arrow(-1, 0, () => swipeTo(state.at + 0.02)),
    arrowup: arrow(0, 1, () => step(-1)), arrowdown: arrow(0, -1, () => step(1)), home: () => swipeTo(0), end: () => swipeTo(1),
    b: stepBack, r: reset, f: () => (event.shiftKey ? toggleFull() : state.solid ? frameScene() : zoomTo(1)),
    v: () => toggle("solid"), p: () => toggle("shape"), c: () => toggle("frustums"),
    "+": () => nearer(KEY_ZOOM), "=": () => nearer(KEY_ZOOM), "-": () => nearer(1 / KEY_ZOOM), 0: () => zoomTo(1),
    " ": () => { state.other = true; show(); },
  };
  if (FLIGHT[letter] && state.solid) takeOff(letter, event.shiftKey);
  else if (MODES[key] && data.sources.length > 1) set("mode", MODES[key]);
  else if (actions[key] && !(key === " " && ["BUTTON", "SUMMARY"].includes(event.target.tagName))) actions[key]();
  else return;
  event.preventDefault();
}

function listen() {
  document.addEventListener("keydown", onKey);
  document.addEventListener("keyup", (event) => {
    flying.delete(event.code.replace("Key", "").toLowerCase());
    if (event.key === " " && state.other && state.mode !== "blink") set("other", false);
  });
  window.addEventListener("blur", () => flying.clear());
  document.addEventListener("click", (event) => {
    const clicked = (name) => event.target.closest(`[data-${name}]`);
    if (clicked("set")) set(clicked("set").dataset.set, clicked("set").dataset.value);
    if (clicked("view")) jump(Number(clicked("view").dataset.view));
    if (clicked("result")) choose(Number(clicked("result").dataset.result));
  });
  for (const side of ["left", "right"]) id(`${side}-source`).addEventListener("input", (event) => set(side, Number(event.target.value)));
  if (id("size")) id("size").addEventListener("input", (event) => choose(data.sizes[event.target.value]));
  if (id("overlay-share")) id("overlay-share").addEventListener("input", (event) => set("overlay", event.target.value / 100));
  id("back").addEventListener("click", reset);
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

// Dragging the handle, or any place of whole stills, moves the swipe. Elsewhere one finger turns the camera in 3D and
// shifts enlarged stills. Two fingers zoom and shift in both.
function listenToPointers() {
  const pointers = new Map();
  let [swiping, pressed, before] = [false, -TWICE, state.at];
  const toShare = (event) => {
    const box = stage.getBoundingClientRect();
    return (event.clientX - box.left) / box.width;
  };
  stage.addEventListener("pointerdown", (event) => {
    if (event.target === id("back")) return;
    pointers.set(event.pointerId, event);
    stage.setPointerCapture(event.pointerId);
    if (event.timeStamp - pressed > TWICE) before = state.at;
    pressed = event.timeStamp;
    const whole = !state.solid && state.zoom === 1;
    if (swiping && pointers.size > 1) swipeTo(before);
    swiping = stage.dataset.mode === "swipe" && pointers.size === 1 && (event.target === id("handle") || whole);
    if (swiping) swipeTo(toShare(event));
  });
  stage.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    pointers.set(event.pointerId, event);
    const other = [...pointers.values()].find((one) => one.pointerId !== event.pointerId);
    if (swiping) swipeTo(toShare(event));
    else if (state.solid) drag(last, event, other);
    else dragStill(last, event, other);
  });
  for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, (event) => pointers.delete(event.pointerId));
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("touchstart", (event) => {
    if (event.touches.length > 1) event.preventDefault(); // two fingers do not scroll the page
  }, { passive: false });
  stage.addEventListener("dblclick", (event) => {
    if (event.target === id("back")) return;
    if (state.solid) return turnAbout(event);
    swipeTo(before);
    zoomTo(state.zoom > 1 ? 1 : CLICK_ZOOM, paneAt(event).place);
  });
  stage.addEventListener("wheel", onWheel, { passive: false });
}

// Zooms with the wheel. While stills are whole, turning it towards smaller pictures scrolls the page.
function onWheel(event) {
  const by = WHEEL * clamp(event.deltaY * (event.deltaMode ? LINE : 1) * (event.ctrlKey ? PINCH : 1), -240, 240);
  if (!state.solid && state.zoom === 1 && by > 0) return;
  event.preventDefault();
  if (state.solid) solid.dolly(Math.exp(by));
  else zoomTo(state.zoom * Math.exp(-by), paneAt(event).place);
}

const apart = (one, other) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) || 1;

function drag(last, event, other) {
  const { width, height } = paneAt(event);
  const [dx, dy] = [(event.clientX - last.clientX) / width, (event.clientY - last.clientY) / height];
  if (other) {
    solid.dolly(apart(last, other) / apart(event, other));
    solid.pan(dx / 2, dy / 2);
  } else if (event.shiftKey || event.buttons & 6) solid.pan(dx, dy);
  else solid.orbit(-3 * dx, -3 * dy * (height / width));
}

function dragStill(last, event, other) {
  const { width, height } = paneAt(event);
  const share = other ? 0.5 : 1; // each of two fingers moves the picture by half of its own way
  if (other) {
    const between = { clientX: (event.clientX + other.clientX) / 2, clientY: (event.clientY + other.clientY) / 2 };
    zoomTo((state.zoom * apart(event, other)) / apart(last, other), paneAt(between).place);
  }
  if (state.zoom > 1) shift((share * (event.clientX - last.clientX)) / width, (share * (event.clientY - last.clientY)) / height);
}
