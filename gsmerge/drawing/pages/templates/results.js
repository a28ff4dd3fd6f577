"use strict";
// Shows the chosen result in the headline, the figures, the table and the strip, and shows the scores of a view.

const FIRST_RESULT = Number(data.photos) + Number(data.results.length < data.sources.length - Number(data.photos)); // index of the first result among the sources
const FASTER = 1.2; // the headline mentions a ratio of drawing times from this value on
const times = new Map(); // milliseconds of a frame in 3D, by source
const number = (value, digits) => (value === null ? "-" : value.toFixed(digits));
// Returns the role of a source, for the text that describes its picture to those who cannot see it.
const roleOf = (source) => {
  if (data.photos && source === 0) return "photo";
  if (source < FIRST_RESULT) return "before";
  return data.results.length > 1 ? `after, ${data.sources[source].name}` : "after";
};
const scoreOf = (named, source) => named.scores[source - Number(data.photos)] || [null, null, null];

function make(name, words, settings = {}) {
  const element = document.createElement(name);
  element.textContent = words;
  return Object.assign(element, settings);
}

function showNumbers() {
  const named = view();
  const badge = make("em", named.held_out ? "held out" : "from outside", { className: "badge" });
  id("view-name").replaceChildren(`${named.name} `, ...(named.held_out || named.outside ? [badge] : []));
  const rows = named.scores.map(([psnr, ssim, lpips], i) => {
    const cells = [data.sources[i + Number(data.photos)].name, number(psnr, 2), number(ssim, 3), ...(data.lpips ? [number(lpips, 3)] : [])];
    const row = make("tr", "");
    row.append(...cells.map((words) => make("td", words, { title: words })));
    return row;
  });
  id("scores").replaceChildren(...rows);
}

// Shows a result in the parts of the page around the picture.
function showResult(source) {
  state.result = source;
  const { headline, figures, speed } = data.results[source - FIRST_RESULT];
  id("headline").textContent = headline;
  showSpeed(speed);
  figures.forEach(([words, mark], i) => {
    const figure = id("figures").children[i].querySelector("b");
    figure.className = mark;
    figure.lastElementChild.textContent = figure.children.length > 1 ? `→ ${words}` : words;
  });
  for (const card of id("strip").querySelectorAll(".score:has(b)")) showScore(card, data.views[card.parentElement.dataset.view]);
  markResult();
  orderStrip();
}

function showScore(line, named) {
  const [before] = named.scores[0];
  const [after] = scoreOf(named, state.result);
  line.replaceChildren(`${number(before, 1)} → `, make("b", `${number(after, 1)} dB`, { className: (after || 0) < (before || 0) ? "down" : data.own ? "own" : "" }));
}

// Shows at the end of the headline how much faster a result draws, if it is clearly faster.
function showSpeed(ratio, by = "As drawn by the processor that made this page") {
  const isFaster = ratio !== null && ratio >= FASTER;
  id("speed").textContent = isFaster ? `, ${ratio >= 3 ? `about ${Number(ratio.toPrecision(1))}` : ratio.toFixed(1)}\u00a0×\u00a0faster to draw` : "";
  id("speed").title = isFaster ? by : "";
}

// Measures on this device how much faster the result draws than the input, if both are in 3D.
function measureSpeed() {
  const input = FIRST_RESULT - 1;
  if (!solid || solid.software || data.sizes[0] === input || ![input, state.result].every((source) => solid.has(source))) return;
  const [before, after] = [input, state.result].map((source) => {
    if (!times.has(source)) times.set(source, solid.frameTime(source));
    return times.get(source);
  });
  showSpeed(before / after, `Medians of frames on this device: ${before.toFixed(1)} and ${after.toFixed(1)} ms`);
}

function markResult() {
  if (id("size")) {
    id("size").value = data.sizes.indexOf(state.result);
    id("size-words").textContent = data.results[state.result - FIRST_RESULT].words;
    id("size").setAttribute("aria-valuetext", id("size-words").textContent);
  }
  if (!id("results")) return;
  for (const row of id("results").rows) row.setAttribute("aria-current", String(Number(row.dataset.result) === state.result));
}

// Shows a result on the right side. If the left side shows it already, the left side gets the input.
function choose(source) {
  if (state.left === source) pick("left", FIRST_RESULT - 1);
  pick("right", source);
}

function pick(side, source) {
  id(`${side}-source`).value = source;
  set(side, source);
}

// Orders the views from the worst of the chosen result on, or as in the input. The view from outside comes last.
function orderStrip() {
  const quality = (card) => scoreOf(data.views[card.dataset.view], state.result)[0] ?? Infinity;
  const place = (card) => Number(card.dataset.place);
  const measured = [...id("strip").children].filter((card) => !data.views[card.dataset.view].outside);
  const worstFirst = measured.sort((a, b) => quality(a) - quality(b) || a.dataset.view - b.dataset.view);
  if (id("worst")) worstFirst[0].querySelector(".marks").prepend(id("worst"));
  worstFirst.forEach((card, i) => (card.style.order = state.order === "worst" ? i : place(card)));
  id("strip").lastElementChild.style.order = data.views.length + Math.max(...measured.map(place));
}

// Shows the view that is `count` cards further along the strip.
function step(count) {
  const cards = [...id("strip").children].sort((a, b) => a.style.order - b.style.order);
  const at = cards.findIndex((card) => Number(card.dataset.view) === state.view);
  jump(Number(cards[clamp(at + count, 0, cards.length - 1)].dataset.view));
}
