// three.js' own renderer of Gaussians, in WebGL2.
import { GLTFGaussianSplatLoaderExtension } from 'three/addons/loaders/GLTFGaussianSplatLoaderExtension.js';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { GaussianSplatPLYLoader } from 'three/addons/loaders/GaussianSplatPLYLoader.js';
import { SPLATLoader } from 'three/addons/loaders/SPLATLoader.js';
import { SPZLoader } from 'three/addons/loaders/SPZLoader.js';
import { GaussianSplat } from 'three/addons/objects/GaussianSplat.js';
import * as THREE from 'three/webgpu';
import { addCanvas, show } from './page.js';
import { directionIn, frameBox, lookFrom } from './three-camera.js';

const LOADERS = { ply: GaussianSplatPLYLoader, spz: SPZLoader, splat: SPLATLoader };

show(async ({ file, look, variant, view, parent }) => {
  const canvas = addCanvas(parent, view);
  const renderer = new THREE.WebGPURenderer({ canvas, antialias: false, forceWebGL: true });
  await renderer.init();
  // Files have the colours of the screen. By default three takes them for linear colours, and pictures are washed out.
  if (variant !== 'default') renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  const { object, cameras } = await load(file);
  const scene = new THREE.Scene();
  scene.add(object);
  const ratio = view.width / view.height;
  const camera = look === 'file' ? cameras[0] : new THREE.PerspectiveCamera(view.vertical, ratio, 0.1, 1000);
  if (look === 'photo') lookFrom(camera, view);
  if (look === 'box') frameBox(camera, new THREE.Box3().setFromObject(object));
  renderer.setAnimationLoop(() => renderer.render(scene, camera));
  return directionIn(object, camera);
});

async function load(file) {
  const ending = file.split('.').pop();
  if (ending === 'glb') {
    const loader = new GLTFLoader();
    loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    const { scene, cameras } = await loader.loadAsync(file);
    return { object: scene, cameras };
  }
  return { object: new GaussianSplat(await new LOADERS[ending]().loadAsync(file)) };
}
