// PlayCanvas' engine. Its scenes have no camera; a new one stands at the origin and looks along -z.
import * as pc from 'playcanvas';
import { addCanvas, show, waitFor } from './page.js';

show(async ({ file, look, view, parent }) => {
  const app = await makeApp(addCanvas(parent, view));
  const asset = new pc.Asset('result', 'gsplat', { url: file, filename: file.split('/').pop() });
  const loaded = waitFor(asset, 'load', 'error');
  app.assets.add(asset);
  app.assets.load(asset);
  await loaded;
  const splats = new pc.Entity();
  splats.addComponent('gsplat', { asset });
  app.root.addChild(splats);
  const entity = new pc.Entity();
  entity.addComponent('camera', { clearColor: pc.Color.BLACK, fov: view.vertical, nearClip: 0.1, farClip: 1000 });
  app.root.addChild(entity);
  if (look === 'photo') lookFrom(entity, view);
  if (look === 'box') frameBox(entity, splats.gsplat.customAabb ?? asset.resource.aabb);
  const { x, y, z } = splats.getWorldTransform().clone().invert().transformVector(entity.forward);
  return [x, y, z];
});

async function makeApp(canvas) {
  const options = new pc.AppOptions();
  options.graphicsDevice = await pc.createGraphicsDevice(canvas, { deviceTypes: ['webgl2'], antialias: false });
  options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
  options.resourceHandlers = [pc.TextureHandler, pc.GSplatHandler];
  const app = new pc.AppBase(canvas);
  app.init(options);
  app.setCanvasFillMode(pc.FILLMODE_NONE, canvas.width, canvas.height);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, canvas.width, canvas.height);
  app.start();
  return app;
}

function lookFrom(entity, view) {
  const pose = new pc.Mat4();
  pose.data.set(view.pose);
  entity.setPosition(pose.getTranslation());
  entity.setRotation(new pc.Quat().setFromMat4(pose));
  entity.camera.calculateProjection = (matrix) => matrix.data.set(view.projection);
}

function frameBox(entity, box) {
  const radius = box.halfExtents.length();
  const distance = radius / Math.sin((entity.camera.fov * Math.PI) / 360);
  entity.setPosition(box.center.x, box.center.y, box.center.z + distance);
  entity.lookAt(box.center);
  entity.camera.farClip = 10 * radius;
}
