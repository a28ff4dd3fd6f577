// Cameras of three.js, for its own renderer and for renderers that build on it.
import { Vector3 } from 'three';

/** Give a camera the pose and the projection of the photo's view. */
export function lookFrom(camera, view) {
  camera.matrixAutoUpdate = false;
  camera.matrix.fromArray(view.pose);
  camera.updateMatrixWorld(true);
  camera.projectionMatrix.fromArray(view.projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}

/** Place a camera on the +z side of a box, as viewers of glTF do. The sphere around the box fills its picture. */
export function frameBox(camera, box) {
  const centre = box.getCenter(new Vector3());
  const radius = box.getSize(new Vector3()).length() / 2;
  camera.position.copy(centre);
  camera.position.z += radius / Math.sin((camera.fov * Math.PI) / 360);
  camera.far = 10 * radius;
  camera.updateProjectionMatrix();
  camera.lookAt(centre);
}

/** Return the direction in which a camera looks, in the frame of an object. */
export function directionIn(object, camera) {
  object.updateWorldMatrix(true, false);
  camera.updateWorldMatrix(true, false);
  return camera.getWorldDirection(new Vector3()).transformDirection(object.matrixWorld.clone().invert()).toArray();
}
