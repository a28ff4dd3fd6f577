// gsplat.js. Its cameras look along +z, with y down, like those of .cameras.json.
import * as SPLAT from 'gsplat';
import { addCanvas, show } from './page.js';

show(async ({ file, look, view, parent }) => {
  const scene = new SPLAT.Scene();
  const camera = new SPLAT.Camera();
  const renderer = new SPLAT.WebGLRenderer(addCanvas(parent, view), []);
  renderer.setSize(view.width, view.height);
  const loader = file.endsWith('.ply') ? SPLAT.PLYLoader : SPLAT.Loader;
  await loader.LoadAsync(file, scene, () => {});
  if (look === 'photo') lookFrom(camera, view);
  const draw = () => {
    renderer.render(scene, camera);
    requestAnimationFrame(draw);
  };
  draw();
  const { x, y, z, w } = camera.rotation;
  return [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)];
}, { centred: true });

function lookFrom(camera, view) {
  const { right, up, forward } = view;
  const rows = [0, 1, 2].flatMap((i) => [right[i], -up[i], forward[i]]);
  camera.data.fx = view.fx;
  camera.data.fy = view.fy;
  camera.position = new SPLAT.Vector3(...view.position);
  camera.rotation = SPLAT.Quaternion.FromMatrix3(new SPLAT.Matrix3(...rows));
}
