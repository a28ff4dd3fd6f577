"use strict";
// Converts the page's packed Gaussians to a file that the renderer reads.

const [SPZ, HEADER] = [0x5053474e, 16]; // first word of a .spz, and number of bytes of its header
const BLOCK = 65535; // most bytes of an uncompressed block of a gzip stream

// Returns the .spz of Gaussians that gsmerge/pages/splats.py has packed, as an uncompressed gzip stream.
async function unpackSplats(packed) {
  const bytes = await gunzip(packed);
  const end = bytes.indexOf(10);
  const head = JSON.parse(new TextDecoder().decode(bytes.subarray(0, end)));
  const { count, degree, fraction, sizes, steps } = head;
  const harmonics = 3 * ((degree + 1) ** 2 - 1);
  const raw = new Uint8Array(HEADER + count * (20 + harmonics));
  const numbers = new DataView(raw.buffer);
  [SPZ, 3, count].forEach((value, i) => numbers.setUint32(4 * i, value, true));
  raw.set([degree, fraction], 12);
  let from = end + 1;
  const columns = sizes.map((size) => { // a number is the sum of all differences up to it; their lowest bit is the sign
    const column = new Int32Array(count);
    for (let row = 0, sum = 0; row < count; row++) {
      let value = 0;
      for (let byte = size - 1; byte >= 0; byte--) value = (value << 8) | bytes[from + byte * count + row];
      column[row] = sum += (value >>> 1) ^ -(value & 1);
    }
    from += size * count;
    return column;
  });
  const starts = [0, 9, 10, 13, 16, 20].map((bytesBefore) => HEADER + bytesBefore * count);
  const places = columns.splice(0, head.cameras ? 4 : 3);
  const [opacity, red, green, blue, ...others] = columns;
  const stored = new Uint8ClampedArray(raw.buffer);
  const placeOf = head.cameras ? pixelPlaces(head, places) : (row) => places.map((column) => column[row]);
  for (let row = 0; row < count; row++) {
    const place = placeOf(row);
    for (let byte = 0; byte < 9; byte++) raw[starts[0] + 9 * row + byte] = place[Math.trunc(byte / 3)] >> (8 * (byte % 3));
    const color = starts[2] + 3 * row;
    stored[starts[1] + row] = steps[0] * opacity[row];
    stored[color] = steps[1] * (red[row] + green[row]);
    stored[color + 1] = steps[1] * green[row];
    stored[color + 2] = steps[1] * (blue[row] + green[row]);
    for (let axis = 0; axis < 3; axis++) stored[starts[3] + 3 * row + axis] = steps[2] * others[axis][row];
    const turn = [others[3][row] / head.levels, others[4][row] / head.levels, others[5][row] / head.levels];
    numbers.setUint32(starts[4] + 4 * row, rotationWord(turn), true);
    for (let i = 0; i < harmonics; i++) raw[starts[5] + row * harmonics + i] = others[6 + i][row];
  }
  const blocks = [new Uint8Array([31, 139, 8, 0, 0, 0, 0, 0, 0, 255])];
  for (let start = 0; start < raw.length; start += BLOCK) {
    const size = Math.min(BLOCK, raw.length - start);
    const last = Number(start + size === raw.length);
    blocks.push(new Uint8Array([last, size & 255, size >> 8, ~size & 255, (~size >> 8) & 255]), raw.subarray(start, start + size));
  }
  blocks.push(new Uint32Array([checksum(raw), raw.length]));
  return new Uint8Array(await new Blob(blocks).arrayBuffer());
}

// Returns a function from a row to its fixed-point position, for rows that store a pixel, a shift in it and a depth.
function pixelPlaces({ cameras, width, height, parts, fraction }, [ids, rights, downs, depths]) {
  const unit = 2 ** fraction;
  return (row) => {
    const pixel = ids[row] % (width * height);
    const { viewmat: m, K: [fx, fy, cx, cy] } = cameras[(ids[row] - pixel) / (width * height)];
    const depth = Math.exp(depths[row] / parts[1]);
    const x = ((pixel % width) + 0.5 + rights[row] / parts[0] - cx) / fx * depth - m[3];
    const y = (Math.floor(pixel / width) + 0.5 + downs[row] / parts[0] - cy) / fy * depth - m[7];
    const z = depth - m[11];
    return [0, 1, 2].map((axis) => Math.round(unit * (m[axis] * x + m[4 + axis] * y + m[8 + axis] * z)));
  };
}

// Returns the word of a .spz for a rotation: 2 bits for the largest of xyzw, then a sign and 9 bits for each other one.
function rotationWord(plane) {
  const square = plane.reduce((sum, value) => sum + value * value, 0);
  const quat = [...plane.map((value) => (2 * value) / (1 + square)), (1 - square) / (1 + square)];
  const largest = quat.reduce((best, value, i) => (Math.abs(value) > Math.abs(quat[best]) ? i : best), 0);
  const sign = quat[largest] < 0 ? -1 : 1;
  let word = largest;
  quat.forEach((value, i) => {
    if (i !== largest) word = (word << 10) | (sign * value < 0 ? 512 : 0) | Math.min(511, Math.round(511 * Math.abs(value) * Math.SQRT2));
  });
  return word >>> 0;
}

// Returns the CRC-32 of bytes.
function checksum(bytes) {
  const table = Uint32Array.from({ length: 256 }, (_, byte) => {
    for (let i = 0; i < 8; i++) byte = byte & 1 ? (byte >>> 1) ^ 0xedb88320 : byte >>> 1;
    return byte;
  });
  let sum = -1;
  for (const byte of bytes) sum = table[(sum ^ byte) & 255] ^ (sum >>> 8);
  return ~sum >>> 0;
}
