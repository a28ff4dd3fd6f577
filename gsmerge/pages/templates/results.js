"use strict";
// The chosen result: headline, figures, table, strip; and the scores of a view.

const FIRST_RESULT = Number(data.photos) + Number(data.results.length < data.sources.length - Number(data.photos)); // among the sources
const number = (value, digits) => (value === null ? "-" : value.toFixed(digits));
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

// What stands about the picture, for one of the results.
function showResult(source) {
  state.result = source;
  const { headline, figures } = data.results[source - FIRST_RESULT];
  id("headline").textContent = headline;
  figures.forEach(([words, better], i) => {
    const figure = id("figures").children[i].querySelector("b");
    figure.className = better ? "up" : "";
    figure.lastElementChild.textContent = `→ ${words}`;
  });
  for (const card of id("strip").querySelectorAll(".score:has(b)")) showScore(card, data.views[card.parentElement.dataset.view]);
  markResult();
  orderStrip();
}

function showScore(line, named) {
  const [before] = named.scores[0];
  const [after] = scoreOf(named, state.result);
  line.replaceChildren(`${number(before, 1)} → `, make("b", `${number(after, 1)} dB`, { className: (after || 0) < (before || 0) ? "down" : "" }));
}

function markResult() {
  if (id("result")) id("result").value = state.result;
  if (!id("results")) return;
  for (const row of id("results").rows) row.setAttribute("aria-current", String(Number(row.dataset.result) === state.result));
}

// A result on the right, and beside it what stood there.
function choose(source) {
  if (state.left === source) pick("left", FIRST_RESULT - 1);
  pick("right", source);
}

function pick(side, source) {
  id(`${side}-source`).value = source;
  set(side, source);
}

// The views from the worst of the chosen result, or as the input has them; the one from outside comes last.
function orderStrip() {
  const quality = (card) => scoreOf(data.views[card.dataset.view], state.result)[0] ?? Infinity;
  const place = (card) => Number(card.dataset.place);
  const measured = [...id("strip").children].filter((card) => !data.views[card.dataset.view].outside);
  const worstFirst = measured.sort((a, b) => quality(a) - quality(b) || a.dataset.view - b.dataset.view);
  if (id("worst")) worstFirst[0].querySelector(".marks").prepend(id("worst"));
  worstFirst.forEach((card, i) => (card.style.order = state.order === "worst" ? i : place(card)));
  id("strip").lastElementChild.style.order = data.views.length + Math.max(...measured.map(place));
}

// The view that many cards further along the strip.
function step(count) {
  const cards = [...id("strip").children].sort((a, b) => a.style.order - b.style.order);
  const at = cards.findIndex((card) => Number(card.dataset.view) === state.view);
  jump(Number(cards[clamp(at + count, 0, cards.length - 1)].dataset.view));
}
