// Babylon.js. By default it loads decoders from unpkg.com. Two options prevent that: `spzLibraryUrl` is the address of
// the decoder of .spz, and `fflate` is the module that unpacks .sog.
import * as BABYLON from '@babylonjs/core';
import '@babylonjs/loaders/SPLAT';
import '@babylonjs/loaders/glTF';
import * as fflate from 'fflate';
import { addCanvas, show } from './page.js';

const { Matrix, Vector3 } = BABYLON;

show(async ({ file, look, variant, view, parent }) => {
  const engine = new BABYLON.Engine(addCanvas(parent, view), false);
  const scene = new BABYLON.Scene(engine);
  scene.clearColor = BABYLON.Color4.FromHexString('#000000ff');
  const spzLibraryUrl = new URL('/node_modules/@adobe/spz/dist/spz.js', location).href; // a file that run.mjs serves
  const pluginOptions = variant === 'default' ? {} : { splat: { spzLibraryUrl, fflate } };
  await BABYLON.ImportMeshAsync(file, scene, { pluginOptions });
  const splats = scene.meshes.find((mesh) => mesh.getClassName().startsWith('GaussianSplatting'));
  const world = splats.computeWorldMatrix(true);
  if (look === 'photo') scene.activeCamera = addCamera(scene, view, world);
  if (look === 'file') scene.activeCamera = scene.cameras[0];
  if (look === 'default') scene.createDefaultCamera(true); // only if the file has not set a camera
  if (look === 'box') scene.createDefaultCamera(true, true, true);
  engine.runRenderLoop(() => scene.render());
  const forward = scene.activeCamera.getDirection(Vector3.Forward(scene.useRightHandedSystem));
  return Vector3.TransformNormal(forward, world.clone().invert()).asArray();
});

// Babylon's world is left-handed. Its loaders mirror what they load, so the view is mirrored as well.
function addCamera(scene, view, world) {
  const camera = new BABYLON.FreeCamera('photo', Vector3.Zero(), scene);
  camera.position = Vector3.TransformCoordinates(Vector3.FromArray(view.position), world);
  camera.upVector = Vector3.TransformNormal(Vector3.FromArray(view.up), world);
  camera.setTarget(Vector3.TransformCoordinates(Vector3.FromArray(view.target), world));
  const leftHanded = view.projection.map((x, i) => (i >= 8 && i < 12 ? -x : x)); // for a camera that looks along +z
  camera.freezeProjectionMatrix(Matrix.FromArray(leftHanded));
  return camera;
}
