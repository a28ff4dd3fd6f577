// Open a result in the viewers that people use: node run.mjs FOLDER [--view NAME] [--only TEXT] (see score.py).
import { build } from 'esbuild';
import fs from 'node:fs';
import http from 'node:http';
import os from 'node:os';
import path from 'node:path';
import { parseArgs } from 'node:util';
import puppeteer from 'puppeteer-core';
import { chooseCamera, stem } from './camera.js';

const HERE = import.meta.dirname;
const SECONDS = 60; // longest time for each picture
const PAUSE = 1500; // milliseconds between two pictures that have to be the same

// Each viewer: its name, page, package and variant of the page, and the formats to open for each `look` (see page.js).
const SPLATS = ['ply', 'spz', 'splat'];
const VIEWERS = [
  ['Spark', 'spark', '@sparkjsdev/spark', 'default', { photo: [...SPLATS, 'sog'], default: ['ply'], box: ['ply'] }],
  ['Spark, sharp', 'spark', '@sparkjsdev/spark', '', { photo: [...SPLATS, 'sog'] }],
  ['three', 'three', 'three', 'default', { photo: [...SPLATS, 'glb'] }],
  ['three, linear', 'three', 'three', '', { photo: [...SPLATS, 'glb'], file: ['glb'], box: ['ply', 'glb'] }],
  ['PlayCanvas', 'playcanvas', 'playcanvas', '', {
    photo: ['ply', 'sog', 'lod-meta.json'], default: ['ply'], box: ['ply', 'sog'],
  }],
  ["SuperSplat's viewer", 'supersplat', '@playcanvas/supersplat-viewer', '', {
    photo: ['ply', 'spz', 'sog', 'lod-meta.json'], file: ['sog', 'lod-meta.json'], default: ['ply', 'sog'],
  }],
  ['Babylon', 'babylon', '@babylonjs/core', 'default', { photo: ['spz', 'sog'] }],
  ['Babylon, local decoders', 'babylon', '@babylonjs/core', '', {
    photo: [...SPLATS, 'sog', 'glb', 'lod-meta.json'], file: ['glb'], default: ['glb'], box: ['ply', 'glb'],
  }],
  ['mkkellogg', 'mkkellogg', '@mkkellogg/gaussian-splats-3d', '', { photo: [...SPLATS, 'spz 2'], default: ['ply'] }],
  ['gsplat.js', 'gsplat', 'gsplat', '', { photo: ['ply', 'splat'], default: ['ply'] }],
  ['Cesium', 'cesium', 'cesium', '', { photo: ['glb', 'tileset.json'], box: ['tileset.json'] }],
];

async function main() {
  const options = { view: { type: 'string' }, only: { type: 'string', default: '' } };
  const { values, positionals } = parseArgs({ allowPositionals: true, options });
  const folder = path.resolve(positionals[0]);
  const { files, cameras } = findResults(folder);
  const all = JSON.parse(fs.readFileSync(path.join(folder, cameras)));
  const camera = chooseCamera(all, values.view);
  const pages = fs.mkdtempSync(path.join(os.tmpdir(), 'viewers-'));
  await bundle(pages);
  const server = await serve({ '/pages/': pages, '/results/': folder, '/node_modules/': `${HERE}/node_modules` });
  const browser = await launch();
  fs.mkdirSync(path.join(folder, 'pictures'), { recursive: true });
  const results = [];
  for (const job of listJobs(files).filter((job) => job.name.includes(values.only))) {
    const { format, look, variant } = job;
    const where = { file: `/results/${files[format]}`, cameras: `/results/${cameras}`, name: stem(camera.img_name) };
    const search = new URLSearchParams({ ...where, look, variant });
    const address = `http://127.0.0.1:${server.address().port}/pages/${job.page}.html?${search}`;
    const result = { ...job, ...(await openPage(browser, address, camera, path.join(folder, job.picture))) };
    console.log(job.name, result.error ?? 'opened', `${result.seconds} s`);
    results.push(result);
    const report = { view: camera.img_name, middle: chooseCamera(all).img_name, results };
    fs.writeFileSync(path.join(folder, 'results.json'), JSON.stringify(report, null, 1));
  }
  await browser.close();
  server.close();
  fs.rmSync(pages, { recursive: true });
}

function findResults(folder) {
  const names = fs.readdirSync(folder, { recursive: true });
  const cameras = names.find((name) => name.endsWith('.cameras.json') && !name.endsWith('lod-meta.cameras.json'));
  const result = stem(stem(cameras));
  const files = { 'spz 2': `${result}2.spz`, 'tileset.json': 'tileset.json' };
  for (const ending of ['ply', 'spz', 'sog', 'glb', 'splat']) files[ending] = `${result}.${ending}`;
  files['lod-meta.json'] = names.find((name) => path.basename(name) === 'lod-meta.json');
  return { cameras, files: Object.fromEntries(Object.entries(files).filter(([, name]) => names.includes(name))) };
}

function listJobs(files) {
  const jobs = [];
  for (const [viewer, page, name, variant, looks] of VIEWERS) {
    const { version } = JSON.parse(fs.readFileSync(`${HERE}/node_modules/${name}/package.json`));
    for (const [look, formats] of Object.entries(looks)) {
      for (const format of formats.filter((format) => format in files)) {
        const name = [page, variant, format, look].filter(Boolean).join('_').replace(' ', '');
        jobs.push({ name, viewer, version, page, variant, format, look, picture: `pictures/${name}.png` });
      }
    }
  }
  return jobs;
}

async function bundle(folder) {
  const pages = [...new Set(VIEWERS.map(([, page]) => page))];
  await build({
    entryPoints: pages.map((page) => `${HERE}/${page}.js`),
    outdir: folder,
    bundle: true,
    format: 'esm',
    logLevel: 'error',
    define: { CESIUM_BASE_URL: '"/node_modules/cesium/Build/Cesium/"' }, // where Cesium finds its workers and decoders
  });
  for (const page of pages) {
    const head = '<!doctype html><link rel="icon" href="data:,">';
    const body = '<body style="margin: 0; background: black; overflow: hidden">';
    fs.writeFileSync(`${folder}/${page}.html`, `${head}${body}<script type="module" src="${page}.js"></script>`);
  }
}

async function serve(folders) {
  const scripts = { '.js': 'text/javascript', '.wasm': 'application/wasm' };
  const types = { '.html': 'text/html', '.css': 'text/css', ...scripts };
  const server = http.createServer((request, response) => {
    const { pathname } = new URL(request.url, 'http://127.0.0.1');
    const prefix = Object.keys(folders).find((start) => pathname.startsWith(start));
    const file = prefix && path.join(folders[prefix], decodeURIComponent(pathname.slice(prefix.length)));
    if (!file || !fs.existsSync(file)) return response.writeHead(404).end();
    response.writeHead(200, { 'content-type': types[path.extname(file)] ?? 'application/octet-stream' });
    return fs.createReadStream(file).pipe(response);
  });
  await new Promise((resolve) => server.listen(0, '127.0.0.1', resolve));
  return server;
}

function launch() {
  const software = ['--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'];
  // No other host has an address. So requests of a viewer to the network fail, and are listed.
  const refuse = '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1';
  return puppeteer.launch({
    executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium',
    args: ['--no-sandbox', '--ignore-gpu-blocklist', ...software, refuse],
  });
}

async function openPage(browser, address, { width, height }, picture) {
  const page = await browser.newPage();
  const [refused, messages, start] = [new Set(), new Set(), Date.now()];
  page.on('request', (request) => {
    const url = new URL(request.url());
    if (url.protocol.startsWith('http') && url.hostname !== '127.0.0.1') refused.add(url.href);
  });
  page.on('console', (message) => {
    if (message.type() === 'error') messages.add(message.text().split('\n')[0].slice(0, 200));
  });
  let result;
  try {
    await page.setViewport({ width, height });
    await page.goto(address, { timeout: 1000 * SECONDS });
    await page.waitForFunction('window.opened', { timeout: 1000 * SECONDS - (Date.now() - start) });
    result = await page.evaluate('window.opened');
    if (!(await takePicture(page, picture, start + 1000 * SECONDS))) messages.add('its picture moves');
  } catch (error) {
    result = { ...result, error: error.message.split('\n')[0] };
  }
  await page.close();
  const seconds = Math.round((Date.now() - start) / 1000);
  return { ...result, refused: [...refused], messages: [...messages].slice(0, 5), seconds };
}

// Write the picture of a page to a file; return true if it does not change any more. Viewers still sort and stream
// after they have opened a file, so pictures are taken until two are equal.
async function takePicture(page, file, deadline) {
  let [before, now] = [new Uint8Array(), await page.screenshot()];
  while (Date.now() < deadline && !Buffer.from(now).equals(before)) {
    await new Promise((resolve) => setTimeout(resolve, PAUSE));
    [before, now] = [now, await page.screenshot()];
  }
  fs.writeFileSync(file, now);
  return Buffer.from(now).equals(before);
}

await main();
