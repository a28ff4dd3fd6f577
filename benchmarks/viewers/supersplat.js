// SuperSplat's viewer. Its camera has a position, a target and a field of view, but no roll.
import { defaultSettings } from '@playcanvas/supersplat-viewer/settings';
import { createViewer } from '@playcanvas/supersplat-viewer/viewer';
import { show, waitFor } from './page.js';

show(async ({ file, look, view, parent }) => {
  const style = { rel: 'stylesheet', href: '/node_modules/@playcanvas/supersplat-viewer/dist/viewer.css' };
  document.head.append(Object.assign(document.createElement('link'), style));
  // Unless `noanim` is set or the settings have an animation, its camera circles or swings, away from the photos.
  const options = { renderer: 'webgl', ui: false, noanim: look !== 'file' };
  const settings = look === 'file' ? settingsBeside(file) : { ...defaultSettings(), cameras: camerasFor(look, view) };
  const viewer = await createViewer({ container: parent, contentUrl: file, settings, ...options });
  if (!viewer.state.loaded) await waitFor(viewer.events, 'loaded:changed');
  if (look === 'file') await new Promise((resolve) => setTimeout(resolve, 3000)); // after that, a movement shows
  const splats = viewer.app.root.findComponent('gsplat').entity;
  const camera = viewer.app.root.findComponent('camera').entity;
  const { x, y, z } = splats.getWorldTransform().clone().invert().transformVector(camera.forward);
  return [x, y, z];
}, { centred: true });

// gsmerge writes settings.json beside lod-meta.json, and NAME.settings.json beside NAME.sog.
function settingsBeside(file) {
  if (file.endsWith('lod-meta.json')) return file.replace('lod-meta.', 'settings.');
  return file.replace(/\.\w+$/, '.settings.json');
}

function camerasFor(look, view) {
  if (look !== 'photo') return [];
  const turn = ([x, y, z]) => [-x, -y, z]; // the viewer turns scenes by half a turn about z
  // The viewer's field of view belongs to the picture's longer side.
  const longer = Math.max(view.width / view.fx, view.height / view.fy);
  const fov = (2 * Math.atan(longer / 2) * 180) / Math.PI;
  return [{ initial: { position: turn(view.position), target: turn(view.target), fov } }];
}
