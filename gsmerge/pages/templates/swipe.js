"use strict";
for (const compare of document.querySelectorAll(".compare")) {
  const layers = compare.querySelectorAll("img.layer");
  const slider = compare.querySelector("input");
  const [left, right] = compare.querySelectorAll("select");
  const show = () => {
    compare.style.setProperty("--at", slider.value + "%");
    layers.forEach((layer, i) => {
      layer.classList.toggle("left", i === Number(left.value));
      layer.classList.toggle("right", i === Number(right.value));
    });
    const name = (select) => select.options[select.selectedIndex].text;
    slider.setAttribute("aria-valuetext", slider.value + " % " + name(left) + ", the rest " + name(right));
  };
  for (const control of [slider, left, right]) control.addEventListener("input", show);
  const frame = compare.querySelector(".frame");
  const drag = (event) => {
    const box = frame.getBoundingClientRect();
    slider.value = Math.round((100 * (event.clientX - box.left)) / box.width);
    show();
  };
  frame.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    frame.setPointerCapture(event.pointerId);
    drag(event);
  });
  frame.addEventListener("pointermove", (event) => {
    if (frame.hasPointerCapture(event.pointerId)) drag(event);
  });
  show();
}
