// Reads a scene: .spz to arrays of means, covariances, opacities and colours.
"use strict";

/** Reads version 2 or 3 of .spz (a gzip stream), as `subsplat` writes it. */
async function parseSpz(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const data = new Uint8Array(await new Response(stream).arrayBuffer());
  const view = new DataView(data.buffer);
  const version = data.length >= 16 ? view.getUint32(4, true) : 0;
  if (version < 2 || version > 3 || view.getUint32(0, true) !== 0x5053474e) {
    throw new Error("The scene is damaged: expected .spz data of version 2 or 3.");
  }
  const count = view.getUint32(8, true);
  const degree = Math.min(data[12], 3);
  const rest = 3 * ((data[12] + 1) ** 2 - 1);
  const quatBytes = version === 3 ? 4 : 3;
  const needed = 16 + count * (9 + 1 + 3 + 3 + quatBytes + rest);
  if (data.length < needed) {
    throw new Error(`The scene is damaged: expected ${needed} bytes, got ${data.length}.`);
  }
  const unit = 1 / 2 ** data[13];
  const means = new Float32Array(3 * count);
  let at = 16;
  for (let i = 0; i < 3 * count; i++, at += 3) {
    const fixed = (data[at] << 8 | data[at + 1] << 16 | data[at + 2] << 24) >> 8;
    means[i] = fixed * unit;
  }
  const opacities = new Float32Array(count);
  for (let i = 0; i < count; i++) opacities[i] = data[at + i] / 255;
  at += count;
  const colours = data.subarray(at, at + 3 * count);
  at += 3 * count;
  const scales = data.subarray(at, at + 3 * count);
  at += 3 * count;
  const quats = data.subarray(at, at + quatBytes * count);
  at += quatBytes * count;
  const covariances = new Float32Array(6 * count);
  const variance = Float32Array.from({ length: 256 }, (_, b) => Math.exp(2 * (b / 16 - 10)));
  const q = [0, 0, 0, 0];
  for (let i = 0; i < count; i++) {
    unpackQuat(quats, quatBytes * i, version, q);
    covariance(q, variance[scales[3 * i]], variance[scales[3 * i + 1]], variance[scales[3 * i + 2]],
      covariances, 6 * i);
  }
  const restBytes = data.subarray(at, at + rest * count);
  return { count, means, opacities, colours, covariances, ...usedSh(restBytes, rest, degree) };
}

/** Unpacks a rotation to x, y, z, w: three bytes (version 2), or the three smallest (version 3). */
function unpackQuat(bytes, at, version, out) {
  if (version === 2) {
    let squares = 0;
    for (let c = 0; c < 3; c++) {
      out[c] = bytes[at + c] / 127.5 - 1;
      squares += out[c] ** 2;
    }
    out[3] = Math.sqrt(Math.max(0, 1 - squares));
    return;
  }
  let code = (bytes[at] | bytes[at + 1] << 8 | bytes[at + 2] << 16 | bytes[at + 3] << 24) >>> 0;
  const largest = code >>> 30;
  let squares = 0;
  for (let c = 3; c >= 0; c--) {
    if (c === largest) continue;
    const size = Math.SQRT1_2 * (code & 511) / 511;
    out[c] = code & 512 ? -size : size;
    squares += size * size;
    code >>>= 10;
  }
  out[largest] = Math.sqrt(Math.max(0, 1 - squares));
}

/** Writes xx, xy, xz, yy, yz, zz of the covariance with variances a, b, c along the axes of q. */
function covariance([x, y, z, w], a, b, c, out, at) {
  const m00 = 1 - 2 * (y * y + z * z), m01 = 2 * (x * y - w * z), m02 = 2 * (x * z + w * y);
  const m10 = 2 * (x * y + w * z), m11 = 1 - 2 * (x * x + z * z), m12 = 2 * (y * z - w * x);
  const m20 = 2 * (x * z - w * y), m21 = 2 * (y * z + w * x), m22 = 1 - 2 * (x * x + y * y);
  out[at] = a * m00 * m00 + b * m01 * m01 + c * m02 * m02;
  out[at + 1] = a * m00 * m10 + b * m01 * m11 + c * m02 * m12;
  out[at + 2] = a * m00 * m20 + b * m01 * m21 + c * m02 * m22;
  out[at + 3] = a * m10 * m10 + b * m11 * m11 + c * m12 * m12;
  out[at + 4] = a * m10 * m20 + b * m11 * m21 + c * m12 * m22;
  out[at + 5] = a * m20 * m20 + b * m21 * m21 + c * m22 * m22;
}

/** Drops degrees of SH that are zero everywhere. */
function usedSh(rest, stride, degree) {
  while (degree > 0) {
    const from = 3 * (degree ** 2 - 1), to = 3 * ((degree + 1) ** 2 - 1);
    let used = false;
    for (let at = 0; at < rest.length && !used; at += stride) {
      for (let k = from; k < to; k++) used ||= rest[at + k] !== 128;
    }
    if (used) break;
    degree--;
  }
  return { degree, rest, restStride: stride };
}

/** Camera z of every `step`-th mean in front of `camera`, sorted. */
function depths(scene, camera, step = 1) {
  const forward = column(camera.rotation, 2);
  const offset = dot(forward, camera.eye);
  const z = new Float32Array(Math.ceil(scene.count / step));
  let n = 0;
  for (let i = 0; i < scene.count; i += step) {
    const v = dot(forward, scene.means.subarray(3 * i, 3 * i + 3)) - offset;
    if (v > 0) z[n++] = v;
  }
  return z.subarray(0, n).sort();
}

/** The middle 96 % of the means along each axis. */
function bounds(scene) {
  const ends = [[0, 0, 0], [0, 0, 0]];
  for (let axis = 0; axis < 3; axis++) {
    const v = new Float32Array(scene.count);
    for (let i = 0; i < scene.count; i++) v[i] = scene.means[3 * i + axis];
    v.sort();
    ends[0][axis] = v[Math.floor(0.02 * (v.length - 1))];
    ends[1][axis] = v[Math.floor(0.98 * (v.length - 1))];
  }
  return ends;
}

/** Sorts the splats in front of the near plane by camera z, nearest first; a radix sort. */
class Sorter {
  constructor(count) {
    this.keys = new Float32Array(count);
    this.bits = new Uint32Array(this.keys.buffer);
    this.spareKeys = new Uint32Array(count);
    this.spare = new Uint32Array(count);
    this.order = new Uint32Array(count);
    this.starts = new Uint32Array(65536);
  }

  /** Sorts all Gaussians of a scene, or those of `chosen`. */
  sort({ means, count }, view, chosen) {
    const [fx, fy, fz] = column(view.rotation, 2);
    const offset = fx * view.eye[0] + fy * view.eye[1] + fz * view.eye[2];
    const { keys, bits, spareKeys, spare, order, starts } = this;
    let n = 0;
    const most = chosen ? chosen.length : Math.min(count, keys.length);
    for (let k = 0; k < most; k++) {
      const i = chosen ? chosen[k] : k, at = 3 * i;
      const z = fx * means[at] + fy * means[at + 1] + fz * means[at + 2] - offset;
      if (z > view.near) {
        keys[n] = z;
        order[n++] = i;
      }
    }
    // Bits of positive floats order as the numbers do.
    const pass = (fromKeys, from, toKeys, to, shift) => {
      starts.fill(0);
      for (let i = 0; i < n; i++) starts[fromKeys[i] >>> shift & 65535]++;
      for (let d = 0, sum = 0; d < 65536; d++) {
        const c = starts[d];
        starts[d] = sum;
        sum += c;
      }
      for (let i = 0; i < n; i++) {
        const place = starts[fromKeys[i] >>> shift & 65535]++;
        toKeys[place] = fromKeys[i];
        to[place] = from[i];
      }
    };
    pass(bits, order, spareKeys, spare, 0);
    pass(spareKeys, spare, bits, order, 16);
    return n;
  }
}
