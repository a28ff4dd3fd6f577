// Cameras of the photos, as in the .cameras.json beside a result, with OpenCV axes: x right, y down.

/** Return the camera whose photo has this name; without a name, the middle one, where gsmerge lets viewers start. */
export function chooseCamera(cameras, name) {
  if (name) return cameras.find((camera) => stem(camera.img_name) === name);
  const positions = cameras.map((camera) => camera.position);
  const forwards = cameras.map((camera) => camera.rotation.map((row) => row[2]));
  const middle = [0, 1, 2].map((i) => positions.map((row) => row[i]).sort((a, b) => a - b)[(cameras.length - 1) >> 1]);
  const sum = [0, 1, 2].map((i) => forwards.reduce((total, row) => total + row[i], 0));
  const mean = sum.map((x) => x / Math.hypot(...sum));
  const distance = (a, b) => Math.hypot(...a.map((x, i) => x - b[i]));
  const distances = positions.map((row) => distance(row, middle));
  const scale = distances.reduce((total, x) => total + x, 0) / cameras.length || 1;
  const costs = distances.map((x, k) => x / scale + distance(forwards[k], mean));
  return cameras[costs.indexOf(Math.min(...costs))];
}

/** Return a file's name without folder and ending. */
export function stem(path) {
  return path.split('/').pop().replace(/\.[^.]*$/, '');
}

/** Enlarge the picture of a camera until the camera's axis meets its middle, as it always does in some viewers. */
export function centre(camera) {
  const { width, height, cx = width / 2, cy = height / 2 } = camera;
  const [wide, high] = [2 * Math.max(cx, width - cx), 2 * Math.max(cy, height - cy)].map(Math.round);
  return { ...camera, width: wide, height: high, cx: wide / 2, cy: high / 2, left: wide / 2 - cx, top: high / 2 - cy };
}

/** Describe a camera in the frame of the file that is opened, in the ways in which viewers want it. */
export function placeView(camera, file) {
  // glTF has y up. So gsmerge turns the scene in a .glb by half a turn about z, compared with its other files.
  const turn = /(\.glb|tileset\.json)$/.test(file) ? [-1, -1, 1] : [1, 1, 1];
  const column = (k) => camera.rotation.map((row, i) => turn[i] * row[k]);
  const negate = (vector) => vector.map((x) => -x);
  const position = camera.position.map((x, i) => turn[i] * x);
  const [right, down, forward] = [0, 1, 2].map(column);
  const { width, height, fx, fy, cx = width / 2, cy = height / 2, left = 0, top = 0 } = camera;
  return {
    position, right, up: negate(down), forward, width, height, fx, fy, cx, cy, left, top,
    target: position.map((x, i) => x + 20 * forward[i]),
    vertical: (2 * Math.atan(height / 2 / fy) * 180) / Math.PI, // field of view in degrees
    // OpenGL's matrices, column by column: its cameras look along -z, with y up.
    pose: [...right, 0, ...negate(down), 0, ...negate(forward), 0, ...position, 1],
    projection: projectionMatrix({ width, height, fx, fy, cx, cy }, 0.1, 1000),
  };
}

function projectionMatrix({ width, height, fx, fy, cx, cy }, near, far) {
  const depth = far - near;
  const middle = [1 - (2 * cx) / width, (2 * cy) / height - 1, -(far + near) / depth, -1];
  return [(2 * fx) / width, 0, 0, 0, 0, (2 * fy) / height, 0, 0, ...middle, 0, 0, (-2 * far * near) / depth, 0];
}

/** Return the angle between two directions in degrees. */
export function angleBetween(a, b) {
  const cosine = a.reduce((sum, x, i) => sum + x * b[i], 0) / (Math.hypot(...a) * Math.hypot(...b));
  return (Math.acos(Math.max(-1, Math.min(1, cosine))) * 180) / Math.PI;
}
