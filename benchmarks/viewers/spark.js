// Spark on three's WebGL renderer.
import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';
import * as THREE from 'three';
import { addCanvas, show } from './page.js';
import { frameBox, lookFrom, directionIn } from './three-camera.js';

show(async ({ file, look, variant, view, parent }) => {
  const renderer = new THREE.WebGLRenderer({ canvas: addCanvas(parent, view), antialias: false });
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(view.vertical, view.width / view.height, 0.1, 1000);
  // gsmerge draws Gaussians without antialiasing. Spark's default uses it, and its pictures are softer.
  const sharp = variant === 'default' ? {} : { preBlurAmount: 0.3, blurAmount: 0 };
  scene.add(new SparkRenderer({ renderer, ...sharp }));
  const mesh = new SplatMesh({ url: file });
  await mesh.initialized;
  scene.add(mesh);
  if (look === 'photo') lookFrom(camera, view);
  if (look === 'box') frameBox(camera, mesh.getBoundingBox(false));
  renderer.setAnimationLoop(() => renderer.render(scene, camera));
  return directionIn(mesh, camera);
});
