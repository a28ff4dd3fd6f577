// Reads a file of Gaussians with three.js' loaders, or spz-js, and writes float32 positions and bytes of colours and
// opacities beside each other: node open_formats.mjs PACKAGES LIBRARY FILE OUT. Of a .glb also what gltf-validator says.
import { readFileSync, writeFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { pathToFileURL } from 'node:url';

const [packages, library, file, out] = process.argv.slice(2);
const require = createRequire(`${packages}/package.json`);
const load = (name) => import(pathToFileURL(require.resolve(name)));
const addon = (name) => load(`three/addons/${name}.js`);
globalThis.self = globalThis; // which loaders of three.js take for granted

const readers = {
  three: {
    ply: async (data) => new (await addon('loaders/GaussianSplatPLYLoader')).GaussianSplatPLYLoader().parse(data),
    splat: async (data) => new (await addon('loaders/SPLATLoader')).SPLATLoader().parse(data),
    spz: async (data) => new (await addon('loaders/SPZLoader')).SPZLoader().parse(data),
    glb: async (data) => {
      const { GLTFLoader } = await addon('loaders/GLTFLoader');
      const { GLTFGaussianSplatLoaderExtension } = await addon('loaders/GLTFGaussianSplatLoaderExtension');
      const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
      let geometry;
      (await loader.parseAsync(data, '')).scene.traverse((node) => (geometry ??= node.splatGeometry));
      return geometry;
    },
  },
};

const bytes = readFileSync(file);
if (library === 'gltf-validator') {
  const report = await require(library).validateBytes(new Uint8Array(bytes));
  writeFileSync(out, JSON.stringify(report.issues));
} else {
  const data = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
  const { position, color } = (await readers[library][file.split('.').pop()](data)).attributes;
  const head = Buffer.from(new Uint32Array([position.count]).buffer);
  writeFileSync(out, Buffer.concat([head, Buffer.from(new Float32Array(position.array).buffer), Buffer.from(color.array)]));
}
