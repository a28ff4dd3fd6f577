// What the pages of all viewers share: they read their task from the address and say when the file is open.
import { angleBetween, centre, chooseCamera, placeView } from './camera.js';

/**
 * Open the file that the address names with `open`, which gets { file, look, variant, view, parent }.
 *
 * It draws into `parent` and returns the direction that its camera looks in, in the frame of the file.
 * `look` is where from: photo (the photo's view), file (a camera that the result brings), box (all of the bounding box)
 * or default (where the viewer stands if it is told nothing). The variant "default" is without our settings.
 * With `centred`, `parent` is larger than the picture, so that the axis of the view meets its middle.
 */
export async function show(open, { centred = false } = {}) {
  addEventListener('error', (event) => report(event.error ?? event.message));
  addEventListener('unhandledrejection', (event) => report(event.reason));
  try {
    const { file, look, variant, cameras, name } = Object.fromEntries(new URLSearchParams(location.search));
    const all = await (await fetch(cameras)).json();
    const camera = chooseCamera(all, name);
    const view = placeView(centred ? centre(camera) : camera, file);
    const parent = document.createElement('div');
    parent.style.cssText = `width: ${view.width}px; height: ${view.height}px; position: absolute`;
    Object.assign(parent.style, { left: `${-view.left}px`, top: `${-view.top}px` });
    document.body.append(parent);
    const forward = await open({ file, look, variant, view, parent });
    window.opened ??= { angle: angleBetween(forward, placeView(chooseCamera(all), file).forward) };
  } catch (error) {
    report(error);
  }
}

// The first error is what the driver gets. Some viewers throw outside of what they promise.
function report(error) {
  window.opened ??= { error: String(error?.message ?? error) };
}

/** Add a canvas of the view's size. */
export function addCanvas(parent, { width, height }) {
  const canvas = document.createElement('canvas');
  Object.assign(canvas, { width, height });
  canvas.style.cssText = `width: ${width}px; height: ${height}px; display: block`;
  parent.append(canvas);
  return canvas;
}

/** Resolve when an emitter says `event`, reject when it says `failure`. */
export function waitFor(emitter, event, failure) {
  return new Promise((resolve, reject) => {
    emitter.on(event, resolve);
    if (failure) emitter.on(failure, reject);
  });
}
