// Cesium. It reads a .spz inside a .glb, by itself or as the tile of a tileset.json.
import * as Cesium from 'cesium';
import { show } from './page.js';

const { Cartesian3, Matrix4 } = Cesium;
// An arbitrary place above the ground, because Cesium draws on a globe.
const PLACE = Cesium.Transforms.eastNorthUpToFixedFrame(Cartesian3.fromDegrees(10, 50, 100));

show(async ({ file, look, view, parent }) => {
  Cesium.Ion.defaultAccessToken = '';
  const style = document.createElement('style');
  style.textContent = '.cesium-widget, .cesium-widget canvas { width: 100%; height: 100% }';
  document.head.append(style);
  const bare = { baseLayer: false, globe: false, skyBox: false, skyAtmosphere: false };
  const credits = document.createElement('div'); // not part of the page, so that no credits cover the picture
  const widget = new Cesium.CesiumWidget(parent, { ...bare, creditContainer: credits });
  const { scene, camera } = widget;
  scene.backgroundColor = Cesium.Color.BLACK;
  const failed = new Promise((_, reject) => {
    scene.renderError.addEventListener((_scene, error) => reject(error));
  });
  const opened = file.endsWith('.glb') ? openModel(file, scene) : openTiles(file, scene);
  const { loaded, sphere } = await opened;
  if (look === 'photo') lookFrom(camera, view);
  else camera.flyToBoundingSphere(sphere(), { duration: 0 });
  await Promise.race([loaded, failed]);
  const [x, y, z] = Cartesian3.pack(turnBack(camera.direction), []);
  return [-x, z, y];
}, { centred: true });

async function openTiles(file, scene) {
  const tiles = await Cesium.Cesium3DTileset.fromUrl(file, { modelMatrix: PLACE, maximumScreenSpaceError: 1 });
  scene.primitives.add(tiles);
  const loaded = new Promise((resolve, reject) => {
    tiles.allTilesLoaded.addEventListener(resolve);
    tiles.tileFailed.addEventListener(({ message }) => reject(message));
  });
  return { loaded, sphere: () => tiles.boundingSphere };
}

async function openModel(file, scene) {
  const model = await Cesium.Model.fromGltfAsync({ url: file, modelMatrix: PLACE });
  scene.primitives.add(model);
  const loaded = new Promise((resolve, reject) => {
    model.readyEvent.addEventListener(resolve);
    model.errorEvent.addEventListener(reject);
  });
  return { loaded, sphere: () => model.boundingSphere };
}

function lookFrom(camera, view) {
  const place = ([x, y, z]) => new Cartesian3(-x, z, y); // as the tileset turns glTF's y up to Cesium's z up
  const turn = (vector) => Matrix4.multiplyByPointAsVector(PLACE, place(vector), new Cartesian3());
  const { width, height, fx, fy } = view;
  const fov = 2 * Math.atan(Math.max(width / fx, height / fy) / 2); // field of view of the longer side, radians
  camera.frustum = new Cesium.PerspectiveFrustum({ fov, aspectRatio: width / height, near: 0.1, far: 10000 });
  const destination = Matrix4.multiplyByPoint(PLACE, place(view.position), new Cartesian3());
  camera.setView({ destination, orientation: { direction: turn(view.forward), up: turn(view.up) } });
}

function turnBack(direction) {
  const inverse = Matrix4.inverseTransformation(PLACE, new Matrix4());
  return Matrix4.multiplyByPointAsVector(inverse, direction, new Cartesian3());
}
