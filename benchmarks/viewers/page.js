// Shared by the pages of all viewers. A page reads its task from its address, and reports when the file is open.
import { angleBetween, centre, chooseCamera, placeView } from './camera.js';

/**
 * Open the file that the address names with `open`, which gets { file, look, variant, view, parent }.
 *
 * `open` draws into `parent` and returns the direction in which its camera looks, in the frame of the file.
 * `look` says where the camera is: photo (the photo's view), file (a camera of the result or its settings), box (so
 * that it sees all of the bounding box) or default (where the viewer stands without any camera). The variant "default"
 * uses none of our settings. With `centred`, `parent` is larger than the picture, so that the axis of the view meets
 * the middle of `parent`.
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

// Report an error to run.mjs, unless something was reported before. Some viewers throw errors outside their promises.
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

/** Return a promise that resolves when an emitter emits `event`, and rejects when it emits `failure`. */
export function waitFor(emitter, event, failure) {
  return new Promise((resolve, reject) => {
    emitter.on(event, resolve);
    if (failure) emitter.on(failure, reject);
  });
}
