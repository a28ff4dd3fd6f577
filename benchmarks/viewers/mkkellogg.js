// mkkellogg's GaussianSplats3D, on three. It reads .spz of version 2 only.
import * as GaussianSplats3D from '@mkkellogg/gaussian-splats-3d';
import { show } from './page.js';
import { directionIn } from './three-camera.js';

show(async ({ file, look, view, parent }) => {
  const place = { cameraUp: view.up, initialCameraPosition: view.position, initialCameraLookAt: view.target };
  const viewer = new GaussianSplats3D.Viewer({
    rootElement: parent,
    sharedMemoryForWorkers: false, // shared memory would need special headers from the server
    sphericalHarmonicsDegree: 2,
    sceneRevealMode: GaussianSplats3D.SceneRevealMode.Instant,
    ...(look === 'photo' ? place : {}),
  });
  if (look === 'photo') viewer.camera.fov = view.vertical;
  await viewer.addSplatScene(file, { showLoadingUI: false, progressiveLoad: false, splatAlphaRemovalThreshold: 0 });
  viewer.start();
  return directionIn(viewer.getSplatMesh(), viewer.camera);
}, { centred: true });
