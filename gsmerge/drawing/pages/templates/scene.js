"use strict";
// The 3D view: one canvas, one camera, and a scene for each result. A frame is drawn only when it is requested.

const FEWER = 0.5; // share of the pixels per side that are drawn without a GPU, and while the camera moves if frames are slow
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i; // names of renderers that draw on the processor
const SLOW_FRAME = 90; // milliseconds from which on a frame is slow
const FRAMES = 7; // number of frames whose median time is measured
const REST = 160; // milliseconds without a movement after which the camera is at rest
const SOLID = 0.1; // least opacity of the Gaussians that are shown as points, or that frameAll brings into the picture
const FRAMED = 0.8; // share of the Gaussians that frameAll brings into the picture, since some may lie far away
const GAIN_POINTS = 1.6; // side of a point, pixels of the screen
// Spark leaves out Gaussians whose centre is far outside the picture, since their footprints grow without bounds there.
// gsmerge, like gsplat, draws them with the footprint of a direction 15 % outside the picture.
const EVERYWHERE = 1e6; // distance from the picture's middle up to which Spark draws Gaussians, in half pictures
const FOOTPRINT = "vec2 J2 = -(J1 * viewCenter.xy) * invZ;";
const BOUNDED_FOOTPRINT = `vec2 seen = clamp(clipCenter.xy / clipCenter.w, -1.3, 1.3);
  vec2 principal = vec2(projectionMatrix[2][0], projectionMatrix[2][1]);
  vec2 J2 = J1 * (seen + principal) / vec2(projectionMatrix[0][0], projectionMatrix[1][1]);`;
const COLORS = { input: [1, 0.78, 0.28], held: [0.42, 0.78, 1], current: [1, 1, 1] };

// Returns the bytes that a script element holds in base64, and removes the element to free memory.
function takeBytes(name) {
  const element = document.getElementById(name);
  const text = element.textContent.trim();
  element.remove();
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

async function gunzip(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Unpacks and runs the script of the renderer, whose exports are then in `Vendor`. A zero byte and the renderer's
// WebAssembly follow the script.
async function loadVendor(packed) {
  const bytes = await gunzip(packed);
  const end = bytes.indexOf(0);
  window.sparkModule = bytes.slice(end + 1);
  const script = document.createElement("script");
  script.src = URL.createObjectURL(new Blob([bytes.subarray(0, end)], { type: "text/javascript" }));
  await new Promise((resolve, reject) => {
    script.onload = resolve;
    script.onerror = () => reject(new Error("the renderer does not load"));
    document.head.append(script);
  });
  URL.revokeObjectURL(script.src);
}

class SplatView {
  // `frame()` returns what is to be drawn. `onMove` is called when the camera moves, and `onSettle` with true when camera
  // and sorting are at rest.
  constructor(canvas, views, frame, onMove, onSettle) {
    Object.assign(this, { canvas, views, frame, onMove, onSettle });
    const options = { canvas, antialias: false, alpha: true, powerPreference: "high-performance" };
    this.renderer = new Vendor.WebGLRenderer(options);
    this.renderer.setPixelRatio(1);
    const context = this.renderer.getContext();
    const names = context.getExtension("WEBGL_debug_renderer_info");
    this.software = SOFTWARE.test(names ? context.getParameter(names.UNMASKED_RENDERER_WEBGL) : "");
    this.camera = new Vendor.PerspectiveCamera(60, 1, 0.01, 1000);
    this.camera.matrixAutoUpdate = false;
    this.results = new Map();
    this.version = 0; // number of changes of the camera
    this.queued = false;
    this.moving = false;
    this.slow = false;
    this.lastDraw = 0;
    this.timer = 0;
    this.poses = views.map(poseOf);
    this.up = this.poses.reduce((sum, pose) => sum.add(column(pose, 1)), new Vendor.Vector3()).normalize();
    this.helpers = new Vendor.Scene();
    this.difference = makeDifference();
  }

  has(source) {
    return this.results.has(source);
  }

  async add(source, fileBytes, fileName = "scene.spz", antialiased = false) {
    const mesh = new Vendor.SplatMesh({ fileBytes, fileName });
    await mesh.initialized;
    // Like gsmerge's own renderer: sorting by depth, a low-pass filter of 0.3 square pixels, no opacities below 1/255.
    // The filter before the blur keeps opacities; the blur lowers those of small Gaussians, as antialiased viewers do
    const filter = antialiased ? { preBlurAmount: 0, blurAmount: 0.3 } : { preBlurAmount: 0.3, blurAmount: 0 };
    const spark = new Vendor.SparkRenderer({
      renderer: this.renderer, autoUpdate: false, sortRadial: false, ...filter,
      maxStdDev: Math.sqrt(2 * Math.log(255)), minAlpha: 1 / 255, maxPixelRadius: 4096, clipXY: EVERYWHERE, onDirty: () => this.request(),
    });
    if (!spark.material.vertexShader.includes(FOOTPRINT)) throw new Error("another renderer than expected");
    spark.material.vertexShader = spark.material.vertexShader.replace(FOOTPRINT, BOUNDED_FOOTPRINT);
    const pane = spark.uniforms.renderSize.value;
    spark.onBeforeRender = (...values) => { // Spark assumes that the picture has the size of the whole canvas
      Vendor.SparkRenderer.prototype.onBeforeRender.apply(spark, values);
      if (!this.renderer.xr.isPresenting) pane.set(this.pane[2], this.pane[3]);
    };
    const scene = new Vendor.Scene();
    scene.add(spark, mesh);
    this.results.set(source, { mesh, spark, scene, version: -1, busy: false, points: null });
  }

  // Takes exactly the camera of a view, with its roll, principal point and both focal lengths.
  look(index) {
    this.view = this.views[index];
    this.current = index;
    this.camera.matrix.copy(this.poses[index]);
    this.target = this.ahead(this.view.distance);
    this.changed();
  }

  ahead(distance) {
    const pose = this.camera.matrix;
    return column(pose, 3).addScaledVector(column(pose, 2), -distance);
  }

  changed() {
    const [fx, fy, cx, cy] = this.view.K;
    const { width, height } = this.view;
    const [near, far] = [this.camera.near, this.camera.far];
    this.camera.projectionMatrix.set(
      (2 * fx) / width, 0, 1 - (2 * cx) / width, 0,
      0, (2 * fy) / height, (2 * cy) / height - 1, 0,
      0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near),
      0, 0, -1, 0,
    );
    this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
    this.camera.updateMatrixWorld(true);
    this.version++;
    this.request();
  }

  // Turns the camera about the target, by `dx` radians about the scene's up and `dy` about the picture's right.
  orbit(dx, dy) {
    const about = (axis, angle) => {
      const there = new Vendor.Matrix4().makeTranslation(this.target.x, this.target.y, this.target.z);
      const turn = new Vendor.Matrix4().makeRotationAxis(axis, angle);
      const back = new Vendor.Matrix4().makeTranslation(-this.target.x, -this.target.y, -this.target.z);
      this.camera.matrix.premultiply(there.multiply(turn).multiply(back));
    };
    about(this.up, dx);
    about(column(this.camera.matrix, 0).normalize(), dy);
    this.moved();
  }

  // Shifts the picture by shares of its width and height.
  pan(dx, dy) {
    const distance = column(this.camera.matrix, 3).distanceTo(this.target);
    const shift = column(this.camera.matrix, 0).multiplyScalar((-dx * distance * this.view.width) / this.view.K[0]);
    shift.addScaledVector(column(this.camera.matrix, 1), (dy * distance * this.view.height) / this.view.K[1]);
    this.target.add(shift);
    this.place(column(this.camera.matrix, 3).add(shift));
  }

  // Moves the camera to `factor` times its distance from the target.
  dolly(factor) {
    this.place(column(this.camera.matrix, 3).sub(this.target).multiplyScalar(factor).add(this.target));
  }

  // Moves the camera and the target, by multiples of the distance between them.
  fly(right, up, ahead) {
    const centre = column(this.camera.matrix, 3);
    const distance = centre.distanceTo(this.target);
    const shift = [right, up, -ahead].reduce((sum, by, axis) => sum.addScaledVector(column(this.camera.matrix, axis), by * distance), new Vendor.Vector3());
    this.target.add(shift);
    this.place(centre.add(shift));
  }

  // Moves the camera until most of a scene is in the picture, without turning it. The scene's middle becomes the target.
  frameAll(source) {
    const places = [[], [], []];
    this.results.get(source).mesh.forEachSplat((_, centre, scales, turn, opacity) => {
      if (opacity >= SOLID) centre.toArray().forEach((value, axis) => places[axis].push(value));
    });
    if (!places[0].length) return;
    const share = (values, part) => Float64Array.from(values).sort()[Math.floor(part * (values.length - 1))];
    const middle = places.map((values) => share(values, 0.5));
    const distances = places[0].map((_, i) => Math.hypot(...middle.map((value, axis) => places[axis][i] - value)));
    const { width, height, K: [fx, fy] } = this.view;
    const distance = share(distances, FRAMED) / Math.sin(Math.atan(Math.min(width / fx, height / fy) / 2));
    this.target = new Vendor.Vector3(...middle);
    this.place(this.target.clone().addScaledVector(column(this.camera.matrix, 2), distance));
  }

  // Returns the point that is seen at a place of the picture, which is given in shares of it: the depth at which half of
  // the light is stopped. Returns null if less than half is stopped.
  pointAt(source, x, y) {
    const { width, height, K: [fx, fy, cx, cy] } = this.view;
    const ray = new Vendor.Vector3((x * width - cx) / fx, (cy - y * height) / fy, -1);
    const toCamera = this.camera.matrix.clone().invert();
    const met = [];
    const point = new Vendor.Vector3();
    this.results.get(source).mesh.forEachSplat((_, centre, scales, turn, opacity) => {
      point.copy(centre).applyMatrix4(toCamera);
      const depth = -point.z;
      if (depth <= this.camera.near) return;
      const size = (scales.x + scales.y + scales.z) / 3 + depth / fx; // a pixel more, so that thin Gaussians are hit
      const off = Math.hypot(point.x - ray.x * depth, point.y - ray.y * depth) / size;
      if (off < 3) met.push([depth, opacity * Math.exp(-off * off / 2)]);
    });
    let open = 1;
    for (const [depth, opacity] of met.sort((a, b) => a[0] - b[0])) {
      open *= 1 - opacity;
      if (open < 0.5) return ray.multiplyScalar(depth).applyMatrix4(this.camera.matrix);
    }
    return null;
  }

  place(centre) {
    this.camera.matrix.setPosition(centre);
    this.moved();
  }

  moved() {
    this.moving = true;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      this.moving = false;
      this.request();
    }, REST);
    this.changed();
    this.onMove();
  }

  request() {
    if (this.queued || !this.frame().shown) return;
    this.queued = true;
    this.onSettle(false);
    requestAnimationFrame(() => this.draw());
  }

  // Sorts and colours a result for the current camera; only one pass runs at a time.
  async refresh(result) {
    if (result.busy || result.version === this.version) return;
    result.busy = true;
    result.version = this.version;
    await result.spark.update({ scene: result.scene, camera: this.camera });
    result.busy = false;
    this.request();
  }

  // Sorts and colours all results before the first frame is shown.
  async prepare() {
    for (const result of this.results.values()) await this.refresh(result);
  }

  draw() {
    this.queued = false;
    const now = performance.now();
    if (this.moving) this.slow = now - this.lastDraw > SLOW_FRAME && now - this.lastDraw < 20 * SLOW_FRAME;
    this.lastDraw = now;
    const frame = this.frame();
    const scale = (this.moving && this.slow ? FEWER : 1) * (this.software && !frame.exact ? FEWER : 1);
    const [width, height] = [frame.width, frame.height].map((size) => Math.max(1, Math.round(size * scale)));
    if (this.canvas.width !== width || this.canvas.height !== height) this.renderer.setSize(width, height, false);
    this.renderer.setClearColor(frame.background, 1);
    this.renderer.setScissorTest(false);
    this.renderer.clear();
    const shown = frame.panes.filter((pane) => this.has(pane.source));
    if (frame.difference && shown.length === 2) this.drawDifference(shown, frame);
    else for (const pane of shown) this.drawPane(pane, frame);
    const results = shown.map((pane) => this.results.get(pane.source));
    if (frame.shape === "splats") results.forEach((result) => this.refresh(result));
    this.onSettle(!this.moving && results.every((result) => !result.busy && !result.spark.dirty));
  }

  // Returns the milliseconds of a frame of one result, the median of several; afterwards the screen shows the same as
  // before.
  frameTime(source) {
    const [context, pixel, whole] = [this.renderer.getContext(), new Uint8Array(4), [0, 0, 1, 1]];
    const times = Array.from({ length: FRAMES + 1 }, () => {
      const start = performance.now();
      this.drawPane({ source, box: whole, clip: whole }, { shape: "splats" });
      context.readPixels(0, 0, 1, 1, context.RGBA, context.UNSIGNED_BYTE, pixel); // waits until the frame is drawn
      return performance.now() - start;
    });
    this.draw();
    return times.slice(1).sort((a, b) => a - b)[FRAMES >> 1]; // without the first frame, which also prepares the renderer
  }

  drawPane(pane, frame) {
    const { width, height } = this.canvas;
    const pixels = ([x, y, w, h]) => {
      const left = Math.round(x * width);
      const bottom = Math.round((1 - y - h) * height);
      return [left, bottom, Math.round((x + w) * width) - left, Math.round((1 - y) * height) - bottom];
    };
    this.pane = pixels(pane.box);
    this.renderer.setScissorTest(true);
    this.renderer.setViewport(...this.pane);
    this.renderer.setScissor(...pixels(pane.clip));
    const result = this.results.get(pane.source);
    this.renderer.autoClear = false;
    this.renderer.render(frame.shape === "points" ? this.pointsOf(result) : result.scene, this.camera);
    if (frame.frustums) this.renderer.render(this.frustums(), this.camera);
  }

  drawDifference(panes, frame) {
    const { width, height } = this.canvas;
    const textures = panes.map((pane) => {
      this.renderer.setScissorTest(false);
      this.renderer.clear();
      this.drawPane(pane, frame);
      const texture = new Vendor.FramebufferTexture(width, height);
      this.renderer.copyFramebufferToTexture(texture);
      return texture;
    });
    const { uniforms } = this.difference.children[0].material;
    [uniforms.left.value, uniforms.right.value] = textures;
    this.renderer.render(this.difference, this.camera);
    textures.forEach((texture) => texture.dispose());
  }

  pointsOf(result) {
    if (result.points) return result.points;
    const [places, colors] = [[], []];
    result.mesh.forEachSplat((_, centre, scales, turn, opacity, color) => {
      if (opacity < SOLID) return;
      places.push(centre.x, centre.y, centre.z);
      colors.push(color.r, color.g, color.b);
    });
    const points = new Vendor.Points(geometry(places, colors), flatMaterial(GAIN_POINTS * (window.devicePixelRatio || 1)));
    points.frustumCulled = false;
    result.points = new Vendor.Scene();
    result.points.add(points);
    return result.points;
  }

  // Draws a pyramid in front of every camera, and that of the current one in white.
  frustums() {
    this.helpers.clear();
    const distances = this.views.map((view) => view.distance).sort((a, b) => a - b);
    const depth = 0.08 * distances[distances.length >> 1];
    const [places, colors] = [[], []];
    this.views.forEach((view, index) => {
      if (view.outside) return;
      const [fx, fy, cx, cy] = view.K;
      const corner = (u, v) => new Vendor.Vector3(((u - cx) / fx) * depth, ((cy - v) / fy) * depth, -depth);
      const corners = [[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]].map((at) => corner(...at));
      const tip = new Vendor.Vector3();
      const lines = corners.flatMap((one, i) => [tip, one, one, corners[(i + 1) % 4]]);
      const color = index === this.current ? COLORS.current : view.held_out ? COLORS.held : COLORS.input;
      for (const point of lines) {
        const { x, y, z } = point.clone().applyMatrix4(this.poses[index]);
        places.push(x, y, z);
        colors.push(...color);
      }
    });
    const lines = new Vendor.LineSegments(geometry(places, colors), flatMaterial(1));
    lines.frustumCulled = false;
    this.helpers.add(lines);
    return this.helpers;
  }
}

// Returns the camera-to-world matrix of a view with WebGL's axes: y points up, and z towards the viewer.
function poseOf(view) {
  const pose = new Vendor.Matrix4().set(...view.viewmat).invert();
  return pose.multiply(new Vendor.Matrix4().makeScale(1, -1, -1));
}

function column(matrix, index) {
  return new Vendor.Vector3().setFromMatrixColumn(matrix, index);
}

function geometry(places, colors) {
  const made = new Vendor.BufferGeometry();
  made.setAttribute("position", new Vendor.BufferAttribute(new Float32Array(places), 3));
  made.setAttribute("color", new Vendor.BufferAttribute(new Float32Array(colors), 3));
  return made;
}

// Returns a material that draws sRGB colours unchanged. Lines (size 1) are in front of all that was drawn before.
function flatMaterial(size) {
  return new Vendor.ShaderMaterial({
    uniforms: { size: { value: size } },
    vertexShader: `attribute vec3 color; uniform float size; varying vec3 shade;
      void main() { shade = color; gl_PointSize = size; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
    fragmentShader: "varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }",
    depthTest: size > 1,
  });
}

function makeDifference() {
  const material = new Vendor.ShaderMaterial({
    uniforms: { left: { value: null }, right: { value: null } },
    vertexShader: "varying vec2 at; void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }",
    fragmentShader: `uniform sampler2D left; uniform sampler2D right; varying vec2 at;
      void main() { gl_FragColor = vec4(abs(texture2D(left, at).rgb - texture2D(right, at).rgb), 1.0); }`,
    depthTest: false,
  });
  const quad = new Vendor.Mesh(new Vendor.PlaneGeometry(2, 2), material);
  quad.frustumCulled = false;
  const scene = new Vendor.Scene();
  scene.add(quad);
  return scene;
}
