// The viewer: Gaussians in a canvas, by WebGL2, or on the CPU where the browser has none.
//
// One classic script without imports, because a page opened from file:// may load no module. The
// page (index.html) and every exported scene (scene.html) contain it.
//
// World axes here are those of .spz: x right, y up, z backward. Camera axes are OpenCV's: x right,
// y down, z forward. Projection, low-pass and blending are the crate's `standard` convention
// (kernels/src/cpu/raster/ewa.rs, kernels/src/layout/mod.rs); the movements are those of src/scene/navigation.rs.
"use strict";

const ALPHA_MIN = 1 / 255;
const ALPHA_MAX = 0.999;
const SH_C0 = 0.28209479177387814;
/** The rules of src/scene/levels.rs and src/finish/merge.rs. */
const BLOCK = 1024, CELL_PX = 1, SIGMA_MAX = 1, SHARE_MAX = 0.5, PIXEL_SIDES = 1.4, LOWPASS = 0.3;
const MERGED_OPACITY_MAX = 0.9999, DENSE_OPACITY = 0.35;
/** Bits of a coordinate on the curve: a code is a whole number below 2 to the power of 53. */
const CURVE_BITS = 17;
/** Longest time without a pause while levels are made, ms. */
const SLICE = 8;
/** Coefficients of degree 1 to 3, in the order of `basis`. */
const SH = [
  -0.4886025119029199, 0.4886025119029199, -0.4886025119029199,
  1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792,
  0.5462742152960396, -0.5900435899266435, 2.890611442640554, -0.4570457994644658,
  0.3731763325901154, -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
];

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

// Vectors and 3×3 matrices (row-major arrays of 9).
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const unit = (v) => {
  const length = Math.hypot(...v);
  return length > 1e-20 ? v.map((c) => c / length) : null;
};
const apply = (m, v) => [0, 3, 6].map((r) => m[r] * v[0] + m[r + 1] * v[1] + m[r + 2] * v[2]);
const multiply = (a, b) => {
  const out = [];
  for (let r = 0; r < 9; r += 3) {
    for (let c = 0; c < 3; c++) out.push(a[r] * b[c] + a[r + 1] * b[3 + c] + a[r + 2] * b[6 + c]);
  }
  return out;
};
const column = (m, c) => [m[c], m[3 + c], m[6 + c]];
/** Rotation about the unit vector `axis` by `angle` radians. */
function about([x, y, z], angle) {
  const c = Math.cos(angle), s = Math.sin(angle), t = 1 - c;
  return [
    t * x * x + c, t * x * y - s * z, t * x * z + s * y,
    t * x * y + s * z, t * y * y + c, t * y * z - s * x,
    t * x * z - s * y, t * y * z + s * x, t * z * z + c,
  ];
}
/** Makes the columns of a rotation orthonormal again. */
function orthonormal(m) {
  const forward = unit(column(m, 2));
  const right = unit(add(column(m, 0), forward, -dot(column(m, 0), forward)));
  const down = [
    forward[1] * right[2] - forward[2] * right[1],
    forward[2] * right[0] - forward[0] * right[2],
    forward[0] * right[1] - forward[1] * right[0],
  ];
  return [right[0], down[0], forward[0], right[1], down[1], forward[1],
    right[2], down[2], forward[2]];
}

/** A camera of a scene file (world of the crate, y down) as one of the viewer's world. */
function toViewer(camera) {
  const m = camera.world_from_camera;
  const signs = [1, -1, -1];
  const rotation = [];
  const eye = [];
  for (let r = 0; r < 3; r++) {
    for (let c = 0; c < 3; c++) rotation.push(signs[r] * m[4 * r + c]);
    eye.push(signs[r] * m[4 * r + 3]);
  }
  const { width, height, fx, fy, cx, cy } = camera;
  return { width, height, fx, fy, cx, cy, rotation, eye };
}

/** Camera z of all means in front of `camera`, sorted. */
function depths(scene, camera) {
  const forward = column(camera.rotation, 2);
  const offset = dot(forward, camera.eye);
  const z = new Float32Array(scene.count);
  let n = 0;
  for (let i = 0; i < scene.count; i++) {
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

/** A camera that shows the whole scene, for files without cameras. */
function wholeCamera([low, high]) {
  const side = 512, fov = 0.9;
  const width = Math.max(high[0] - low[0], high[1] - low[1], 1e-3);
  const distance = 0.5 * width / Math.tan(0.5 * fov) + 0.5 * (high[2] - low[2]);
  const eye = add(add(low, high), [0, 0, 2 * distance]).map((c) => 0.5 * c);
  const f = 0.5 * side / Math.tan(0.5 * fov);
  return {
    width: side, height: side, fx: f, fy: f, cx: side / 2, cy: side / 2,
    rotation: [1, 0, 0, 0, -1, 0, 0, 0, -1], eye,
  };
}

/** Intrinsics of `home` for another picture size: square pixels, the whole picture visible. */
function fitted(home, width, height) {
  const scale = Math.min(width / home.width, height / home.height);
  return {
    width, height, fx: scale * home.fx, fy: scale * home.fy,
    cx: 0.5 * width + scale * (home.cx - 0.5 * home.width),
    cy: 0.5 * height + scale * (home.cy - 0.5 * home.height),
  };
}

/** Parameters of projection of a camera: those of kernels/src/layout/view.rs, `standard` convention. */
function projection(camera, rules) {
  const margin = 0.3;
  const limit = [[camera.cx, camera.width, camera.fx], [camera.cy, camera.height, camera.fy]].map(
    ([c, side, f]) => [-c / f - margin * 0.5 * side / f, (side - c) / f + margin * 0.5 * side / f],
  );
  return { ...camera, limit, near: rules.near, lowpass: rules.lowpass };
}

/** The two largest eigenvalues of a covariance (xx, xy, xz, yy, yz, zz). */
function variances([a, xy, xz, b, yz, c]) {
  const mean = (a + b + c) / 3;
  const d = a - mean, e = b - mean, f = c - mean;
  const p = Math.sqrt((d * d + e * e + f * f + 2 * (xy * xy + xz * xz + yz * yz)) / 6);
  if (!(p > 1e-9 * mean)) return [mean, mean];
  const det = d * (e * f - yz * yz) - xy * (xy * f - yz * xz) + xz * (xy * yz - e * xz);
  const angle = Math.acos(Math.min(Math.max(det / (2 * p ** 3), -1), 1)) / 3;
  const first = mean + 2 * p * Math.cos(angle);
  const last = mean + 2 * p * Math.cos(angle + 2 * Math.PI / 3);
  return [first, Math.max(3 * mean - first - last, 0)];
}

/** A function that pauses where a slice of time is over, and returns whether to go on. */
function slices(goesOn) {
  let begin = performance.now();
  return async () => {
    if (performance.now() - begin > SLICE) {
      await new Promise((done) => setTimeout(done));
      begin = performance.now();
    }
    return goesOn();
  };
}

/**
 * Level of detail, as src/scene/levels.rs describes it. Merged Gaussians follow those of the file in `scene`.
 * A block has a bounding sphere, its Gaussians `own`, and levels `coarse` of `count` merged Gaussians.
 */
class Levels {
  /** Makes the levels of `file`; null where `pause` ends the work. */
  static async make(file, pause) {
    const levels = new Levels(file);
    const codes = new Float64Array(file.count);
    for (let i = 0; i < file.count; i++) {
      if (i % 4096 === 0 && !await pause()) return null;
      codes[i] = levels.code(i);
    }
    let order = Uint32Array.from(codes, (_, i) => i), spare = new Uint32Array(file.count);
    const starts = new Uint32Array(8192);
    for (let unit = 1; unit < 2 ** (3 * CURVE_BITS); unit *= 8192) {
      if (!await pause()) return null;
      const digit = (i) => Math.floor(codes[i] / unit) % 8192;
      starts.fill(0);
      for (const i of order) starts[digit(i)]++;
      for (let d = 0, sum = 0; d < 8192; d++) [starts[d], sum] = [sum, sum + starts[d]];
      for (const i of order) spare[starts[digit(i)]++] = i;
      [order, spare] = [spare, order];
    }
    for (let first = 0; first < file.count; first += BLOCK) {
      if (!await pause()) return null;
      levels.add(order.subarray(first, first + BLOCK), codes);
    }
    levels.close();
    return levels;
  }

  constructor(file) {
    this.file = file;
    this.low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    for (let at = 0; at < 3 * file.count; at++) {
      this.low[at % 3] = Math.min(this.low[at % 3], file.means[at]);
      high[at % 3] = Math.max(high[at % 3], file.means[at]);
    }
    this.side = Math.max(...add(high, this.low, -1), 1e-30) / (2 ** CURVE_BITS - 1);
    this.blocks = [];
    /** Rows of merged Gaussians: mean, opacity, covariance; colour and further coefficients, bytes. */
    this.parts = [];
    this.count = file.count;
    this.chosen = new Uint32Array(file.count);
  }

  /** The place of Gaussian `i` on a Morton curve. */
  code(i) {
    const [x, y, z] = [0, 1, 2].map((c) => (this.file.means[3 * i + c] - this.low[c]) / this.side);
    let code = 0;
    for (let bit = CURVE_BITS - 1; bit >= 0; bit--) {
      code = 8 * code + (x >> bit & 1 | (y >> bit & 1) << 1 | (z >> bit & 1) << 2);
    }
    return code;
  }

  entry(i, code) {
    const { means, covariances, opacities, colours, rest, restStride, degree } = this.file;
    const covariance = covariances.subarray(6 * i, 6 * i + 6);
    const used = restStride * i + 3 * ((degree + 1) ** 2 - 1);
    return {
      code, covariance, opacity: opacities[i], mean: means.subarray(3 * i, 3 * i + 3), variances: variances(covariance),
      depth: -Math.log1p(-Math.min(opacities[i], MERGED_OPACITY_MAX)),
      colour: [...colours.subarray(3 * i, 3 * i + 3), ...rest.subarray(restStride * i, used)],
    };
  }

  /** Adds the block of the Gaussians `own` along the curve. */
  add(own, codes) {
    let entries = [];
    for (const i of own) {
      if (this.file.opacities[i] >= ALPHA_MIN) entries.push(this.entry(i, codes[i]));
    }
    const ends = [Math.min, Math.max].map((end) => [0, 1, 2].map(
      (c) => entries.reduce((v, e) => end(v, e.mean[c]), entries[0]?.mean[c] ?? 0)));
    const centre = add(...ends).map((v) => 0.5 * v);
    const radius = entries.reduce((r, e) => Math.max(r, Math.hypot(...add(e.mean, centre, -1))), 0);
    const coarse = [];
    for (let bits = 1; bits <= 3 * CURVE_BITS && entries.length > 1; bits++) {
      const side = this.side * 2 ** (bits / 3), cells = 2 ** bits;
      const merges = (e) => e.variances[0] <= (SIGMA_MAX * side) ** 2;
      const cell = (e) => Math.floor(e.code / cells);
      let count = 0, last = -1;
      for (const e of entries) {
        if (!merges(e) || cell(e) !== last) count++;
        if (merges(e)) last = cell(e);
      }
      if (count > SHARE_MAX * entries.length) continue;
      const lowpass = LOWPASS * (PIXEL_SIDES / CELL_PX * side) ** 2;
      const next = [];
      let group = [];
      const flush = () => {
        if (group.length) next.push(merged(group, lowpass));
        group = [];
      };
      for (const e of entries) {
        if (group.length && cell(e) !== cell(group[0])) flush();
        if (merges(e)) group.push(e);
        else next.push(e);
      }
      flush();
      // A Gaussian between two of another cell may precede the cell's merge.
      entries = next.sort((a, b) => a.code - b.code);
      coarse.push({ side, first: this.count, count });
      this.count += count;
      const geometry = new Float32Array(10 * count);
      entries.forEach((e, k) => geometry.set(
        [...e.mean, e.opacity, ...e.covariance], 10 * k));
      this.parts.push([geometry, Uint8Array.from(entries.flatMap((e) => e.colour.map(Math.round)))]);
    }
    this.blocks.push({ centre, radius, own, coarse });
  }

  /** Appends the merged Gaussians to those of the file. */
  close() {
    const { file, count } = this;
    const longer = (from, stride) => {
      const out = new from.constructor(stride * count);
      out.set(from);
      return out;
    };
    const scene = this.scene = {
      ...file, count, means: longer(file.means, 3), opacities: longer(file.opacities, 1),
      covariances: longer(file.covariances, 6), colours: longer(file.colours, 3),
      rest: longer(file.rest, file.restStride),
    };
    const set = 3 * (file.degree + 1) ** 2;
    let at = file.count;
    for (const [geometry, colours] of this.parts) {
      for (let k = 0; 10 * k < geometry.length; k++, at++) {
        scene.means.set(geometry.subarray(10 * k, 10 * k + 3), 3 * at);
        scene.opacities[at] = geometry[10 * k + 3];
        scene.covariances.set(geometry.subarray(10 * k + 4, 10 * k + 10), 6 * at);
        scene.colours.set(colours.subarray(set * k, set * k + 3), 3 * at);
        scene.rest.set(colours.subarray(set * k + 3, set * (k + 1)), file.restStride * at);
      }
    }
    this.parts = [];
  }

  /** The Gaussians to draw for a view; null for those of the file. */
  select({ eye, fx, fy }) {
    const { chosen } = this;
    let n = 0, whole = true;
    for (const { centre, radius, own, coarse } of this.blocks) {
      const distance = Math.hypot(...add(centre, eye, -1)) - radius;
      let level = null;
      for (const next of coarse) {
        if (next.side * Math.max(fx, fy) > CELL_PX * distance) break;
        level = next;
      }
      if (level) {
        whole = false;
        for (let k = 0; k < level.count; k++) chosen[n++] = level.first + k;
      } else {
        chosen.set(own, n);
        n += own.length;
      }
    }
    return whole ? null : chosen.subarray(0, n);
  }
}

/** Merges entries by their moments; a single one stays as it is. */
function merged(group, lowpass) {
  if (group.length === 1) return group[0];
  const footprint = ([a, b]) => Math.sqrt((a + lowpass) * (b + lowpass));
  let weight = 0;
  const mean = [0, 0, 0], covariance = [0, 0, 0, 0, 0, 0], colour = group[0].colour.map(() => 0);
  for (const e of group) {
    const own = e.depth * footprint(e.variances);
    weight += own;
    const part = own / weight;
    const d = add(e.mean, mean, -1);
    const spread = [d[0] * d[0], d[0] * d[1], d[0] * d[2], d[1] * d[1], d[1] * d[2], d[2] * d[2]];
    for (let c = 0; c < 6; c++) {
      covariance[c] += part * (e.covariance[c] - covariance[c] + (1 - part) * spread[c]);
    }
    for (let c = 0; c < 3; c++) mean[c] += part * d[c];
    for (let c = 0; c < colour.length; c++) colour[c] += part * (e.colour[c] - colour[c]);
  }
  const sizes = variances(covariance);
  const depth = weight / footprint(sizes);
  const opacity = Math.max(-Math.expm1(-depth), DENSE_OPACITY * depth);
  return { code: group[0].code, mean, covariance, colour, variances: sizes, depth, opacity };
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

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
uniform sampler2D geometry;
uniform usampler2D colours;
uniform mat3 cameraFromWorld;
uniform vec3 eye;
uniform vec2 focal, centre, size;
uniform vec4 limit;
uniform float lowpass;
uniform int degree, texels;
in uint index;
out vec2 sigmas;
flat out vec4 colour;

ivec2 place(sampler2D of, int at) {
  int width = textureSize(of, 0).x;
  return ivec2(at % width, at / width);
}

uvec4 packed16(int texel) {
  int width = textureSize(colours, 0).x;
  int at = texels * int(index) + texel;
  return texelFetch(colours, ivec2(at % width, at / width), 0);
}

vec3 coefficient(int k) {
  vec3 out_;
  uvec4 group = packed16(3 * k / 16);
  int first = 3 * k / 16;
  for (int c = 0; c < 3; c++) {
    int byte = 3 * k + c;
    if (byte / 16 != first) { first = byte / 16; group = packed16(first); }
    out_[c] = float((group[byte / 4 % 4] >> uint(8 * (byte % 4))) & 255u);
  }
  return k == 0 ? (out_ / 255.0 - 0.5) / 0.15 : (out_ - 128.0) / 128.0;
}

vec3 shColour(vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.5 + ${SH_C0} * coefficient(0);
  if (degree > 0) {
    sum += ${SH[0]} * y * coefficient(1) + ${SH[1]} * z * coefficient(2) + ${SH[2]} * x * coefficient(3);
  }
  if (degree > 1) {
    sum += ${SH[3]} * x * y * coefficient(4) + ${SH[4]} * y * z * coefficient(5)
      + ${SH[5]} * (2.0 * zz - xx - yy) * coefficient(6) + ${SH[6]} * x * z * coefficient(7)
      + ${SH[7]} * (xx - yy) * coefficient(8);
  }
  if (degree > 2) {
    sum += ${SH[8]} * y * (3.0 * xx - yy) * coefficient(9) + ${SH[9]} * x * y * z * coefficient(10)
      + ${SH[10]} * y * (4.0 * zz - xx - yy) * coefficient(11)
      + ${SH[11]} * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(12)
      + ${SH[12]} * x * (4.0 * zz - xx - yy) * coefficient(13)
      + ${SH[13]} * z * (xx - yy) * coefficient(14) + ${SH[14]} * x * (xx - 3.0 * yy) * coefficient(15);
  }
  return max(sum, 0.0);
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  int at = 3 * int(index);
  vec4 a = texelFetch(geometry, place(geometry, at), 0);
  vec4 b = texelFetch(geometry, place(geometry, at + 1), 0);
  vec4 c = texelFetch(geometry, place(geometry, at + 2), 0);
  if (a.w < ${ALPHA_MIN}) return;
  vec3 p = cameraFromWorld * (a.xyz - eye);
  vec2 slope = p.xy / p.z;
  vec2 bent = clamp(slope, limit.xz, limit.yw);
  mat3 toWorld = transpose(cameraFromWorld);
  vec3 ju = focal.x / p.z * (toWorld[0] - bent.x * toWorld[2]);
  vec3 jv = focal.y / p.z * (toWorld[1] - bent.y * toWorld[2]);
  mat3 sigma = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
  vec3 su = sigma * ju;
  float xx = dot(ju, su) + lowpass, xy = dot(jv, su), yy = dot(jv, sigma * jv) + lowpass;
  float mid = 0.5 * (xx + yy);
  float half_ = length(vec2(0.5 * (xx - yy), xy));
  float long_ = mid + half_;
  float short_ = max(mid - half_, 1e-6);
  vec2 axis = half_ > 1e-9 * mid ? vec2(xy, long_ - xx) : vec2(1.0, 0.0);
  axis = dot(axis, axis) > 0.0 ? normalize(axis) : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float reach = sqrt(2.0 * log(a.w * 255.0) + 1e-4);
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  sigmas = reach * corner;
  vec2 px = focal * slope + centre
    + sigmas.x * sqrt(long_) * axis + sigmas.y * sqrt(short_) * vec2(-axis.y, axis.x);
  colour = vec4(shColour(normalize(a.xyz - eye)), a.w);
  gl_Position = vec4(2.0 * px.x / size.x - 1.0, 1.0 - 2.0 * px.y / size.y, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 sigmas;
flat in vec4 colour;
out vec4 result;
void main() {
  float alpha = min(colour.a * exp(-0.5 * dot(sigmas, sigmas)), ${ALPHA_MAX});
  if (alpha < ${ALPHA_MIN}) discard;
  result = vec4(colour.rgb * alpha, alpha);
}`;

const COPY_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

const COPY_FRAGMENT = `#version 300 es
precision highp float;
uniform highp sampler2D picture;
out vec4 result;
void main() {
  result = vec4(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb, 1.0);
}`;

/** Draws by WebGL2: instanced quads, farthest first, into half floats where the browser can. */
class GlPainter {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", {
      alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true,
    });
    if (!gl) throw new Error("This browser has no WebGL2.");
    this.gl = gl;
    this.canvas = canvas;
    this.half = Boolean(
      gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"),
    );
    this.splats = this.program(VERTEX, FRAGMENT);
    this.copy = this.program(COPY_VERTEX, COPY_FRAGMENT);
    this.indices = gl.createBuffer();
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    const place = gl.getAttribLocation(this.splats, "index");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribIPointer(place, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(place, 1);
    this.empty = gl.createVertexArray();
  }

  get name() {
    return "WebGL2";
  }

  program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const log = gl.getAttachedShaders(program).map((s) => gl.getShaderInfoLog(s)).join("");
      throw new Error(`shader: ${log}${gl.getProgramInfoLog(program)}`);
    }
    return program;
  }

  /** A texture of `rows` rows for each `width` Gaussians of a scene. */
  texture(unitIndex, internal, rows, count) {
    const { gl, width } = this;
    const height = Math.max(1, rows * Math.ceil(count / width));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error("this graphics card holds no scene of this size");
    }
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unitIndex);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, internal, width, height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  /** Textures for a scene, without texels. */
  open(scene) {
    const { gl } = this;
    this.width = Math.min(4096, gl.getParameter(gl.MAX_TEXTURE_SIZE));
    this.texels = Math.ceil(3 * (scene.degree + 1) ** 2 / 16);
    return [
      this.texture(0, gl.RGBA32F, 3, scene.count),
      this.texture(1, gl.RGBA32UI, this.texels, scene.count),
    ];
  }

  /** Fills the rows of the textures that begin with Gaussian `first`. */
  fill([geometry, colours], scene, first) {
    const { gl, width, texels } = this;
    const count = Math.min(width, scene.count - first);
    const numbers = new Float32Array(12 * width);
    const used = 3 * (scene.degree + 1) ** 2, stride = 16 * texels;
    const bytes = new Uint8Array(stride * width);
    for (let k = 0, i = first; k < count; k++, i++) {
      numbers.set(scene.means.subarray(3 * i, 3 * i + 3), 12 * k);
      numbers[12 * k + 3] = scene.opacities[i];
      numbers.set(scene.covariances.subarray(6 * i, 6 * i + 6), 12 * k + 4);
      bytes.set(scene.colours.subarray(3 * i, 3 * i + 3), stride * k);
      const from = scene.restStride * i;
      bytes.set(scene.rest.subarray(from, from + used - 3), stride * k + 3);
    }
    const row = first / width;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, geometry);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 3 * row, width, 3, gl.RGBA, gl.FLOAT, numbers);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, colours);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, texels * row, width, texels, gl.RGBA_INTEGER,
      gl.UNSIGNED_INT, new Uint32Array(bytes.buffer));
  }

  close(textures, scene) {
    [this.geometry, this.colours].forEach((t) => t && this.gl.deleteTexture(t));
    [this.geometry, this.colours] = textures;
    this.degree = scene.degree;
    this.scene = scene;
  }

  load(scene) {
    const textures = this.open(scene);
    for (let i = 0; i < scene.count; i += this.width) this.fill(textures, scene, i);
    this.close(textures, scene);
    this.sorter = new Sorter(scene.count);
  }

  /** Replaces the scene by a longer one with the same beginning; false where `pause` ends the work. */
  async extend(scene, pause) {
    const textures = this.open(scene);
    for (let i = 0; i < scene.count; i += this.width) {
      if (!await pause()) {
        textures.forEach((t) => this.gl.deleteTexture(t));
        return false;
      }
      this.fill(textures, scene, i);
    }
    this.close(textures, scene);
    return true;
  }

  target(width, height) {
    if (!this.half) return null;
    const { gl } = this;
    if (this.size !== `${width}x${height}`) {
      if (this.frame) {
        gl.deleteTexture(this.picture);
        gl.deleteFramebuffer(this.frame);
      }
      this.picture = gl.createTexture();
      gl.activeTexture(gl.TEXTURE2);
      gl.bindTexture(gl.TEXTURE_2D, this.picture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      this.frame = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
      gl.framebufferTexture2D(
        gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.picture, 0);
      if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) this.half = false;
      this.size = `${width}x${height}`;
    }
    return this.half ? this.frame : null;
  }

  draw(view, background, chosen) {
    const { gl, splats } = this;
    const n = this.sorter.sort(this.scene, view, chosen);
    const order = this.sorter.order.subarray(0, n).reverse();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target(view.width, view.height));
    gl.viewport(0, 0, view.width, view.height);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(splats);
    const at = (name) => gl.getUniformLocation(splats, name);
    gl.uniform1i(at("geometry"), 0);
    gl.uniform1i(at("colours"), 1);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.geometry);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.colours);
    // Columns of the matrix are the rows of the rotation, which is its inverse's transpose.
    gl.uniformMatrix3fv(at("cameraFromWorld"), false, [...view.rotation]);
    gl.uniform3f(at("eye"), ...view.eye);
    gl.uniform2f(at("focal"), view.fx, view.fy);
    gl.uniform2f(at("centre"), view.cx, view.cy);
    gl.uniform2f(at("size"), view.width, view.height);
    gl.uniform4f(at("limit"), ...view.limit.flat());
    gl.uniform1f(at("lowpass"), view.lowpass);
    gl.uniform1i(at("degree"), this.degree);
    gl.uniform1i(at("texels"), this.texels);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, n);
    if (this.half) {
      gl.disable(gl.BLEND);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.useProgram(this.copy);
      gl.uniform1i(gl.getUniformLocation(this.copy, "picture"), 2);
      gl.activeTexture(gl.TEXTURE2);
      gl.bindTexture(gl.TEXTURE_2D, this.picture);
      gl.bindVertexArray(this.empty);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 3);
    }
  }

  /** RGBA of the last frame, rows from the top. */
  pixels(width, height) {
    const { gl } = this;
    const rows = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rows);
    const out = new Uint8ClampedArray(rows.length);
    for (let y = 0; y < height; y++) {
      out.set(rows.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
    }
    return out;
  }
}

/** Draws on the CPU, nearest first, for browsers without WebGL2. */
class CpuPainter {
  constructor(canvas) {
    this.context = canvas.getContext("2d", { alpha: false });
    if (!this.context) throw new Error("This browser can draw on no canvas.");
    this.canvas = canvas;
  }

  get name() {
    return "the processor";
  }

  load(scene) {
    this.scene = scene;
    this.sorter = new Sorter(scene.count);
  }

  async extend(scene) {
    this.scene = scene;
    return true;
  }

  colour(i, d, out) {
    const { colours, rest, restStride, degree } = this.scene;
    const [x, y, z] = d, xx = x * x, yy = y * y, zz = z * z;
    const basis = [
      SH[0] * y, SH[1] * z, SH[2] * x, SH[3] * x * y, SH[4] * y * z, SH[5] * (2 * zz - xx - yy),
      SH[6] * x * z, SH[7] * (xx - yy), SH[8] * y * (3 * xx - yy), SH[9] * x * y * z,
      SH[10] * y * (4 * zz - xx - yy), SH[11] * z * (2 * zz - 3 * xx - 3 * yy),
      SH[12] * x * (4 * zz - xx - yy), SH[13] * z * (xx - yy), SH[14] * x * (xx - 3 * yy),
    ];
    const count = (degree + 1) ** 2 - 1;
    for (let c = 0; c < 3; c++) {
      let sum = 0.5 + SH_C0 * (colours[3 * i + c] / 255 - 0.5) / 0.15;
      for (let k = 0; k < count; k++) {
        sum += basis[k] * (rest[restStride * i + 3 * k + c] - 128) / 128;
      }
      out[c] = Math.max(sum, 0);
    }
  }

  draw(view, background, chosen) {
    const { means, covariances, opacities } = this.scene;
    const { width, height, rotation: r, eye, fx, fy, limit, lowpass } = view;
    const n = this.sorter.sort(this.scene, view, chosen);
    const sums = new Float32Array(3 * width * height);
    const through = new Float32Array(width * height).fill(1);
    const rgb = [0, 0, 0];
    for (let k = 0; k < n; k++) {
      const i = this.sorter.order[k];
      const opacity = opacities[i];
      if (opacity < ALPHA_MIN) continue;
      const dx = means[3 * i] - eye[0], dy = means[3 * i + 1] - eye[1];
      const dz = means[3 * i + 2] - eye[2];
      const z = r[2] * dx + r[5] * dy + r[8] * dz;
      const sx = (r[0] * dx + r[3] * dy + r[6] * dz) / z;
      const sy = (r[1] * dx + r[4] * dy + r[7] * dz) / z;
      const bx = Math.min(Math.max(sx, limit[0][0]), limit[0][1]);
      const by = Math.min(Math.max(sy, limit[1][0]), limit[1][1]);
      const u0 = fx / z * (r[0] - bx * r[2]), u1 = fx / z * (r[3] - bx * r[5]);
      const u2 = fx / z * (r[6] - bx * r[8]);
      const v0 = fy / z * (r[1] - by * r[2]), v1 = fy / z * (r[4] - by * r[5]);
      const v2 = fy / z * (r[7] - by * r[8]);
      const c = 6 * i;
      const s0 = covariances[c] * u0 + covariances[c + 1] * u1 + covariances[c + 2] * u2;
      const s1 = covariances[c + 1] * u0 + covariances[c + 3] * u1 + covariances[c + 4] * u2;
      const s2 = covariances[c + 2] * u0 + covariances[c + 4] * u1 + covariances[c + 5] * u2;
      const xx = u0 * s0 + u1 * s1 + u2 * s2 + lowpass;
      const xy = v0 * s0 + v1 * s1 + v2 * s2;
      const yy = lowpass
        + v0 * (covariances[c] * v0 + covariances[c + 1] * v1 + covariances[c + 2] * v2)
        + v1 * (covariances[c + 1] * v0 + covariances[c + 3] * v1 + covariances[c + 4] * v2)
        + v2 * (covariances[c + 2] * v0 + covariances[c + 4] * v1 + covariances[c + 5] * v2);
      const det = xx * yy - xy * xy;
      if (!(det > 0)) continue;
      // Pixel centres lie at whole numbers here.
      const px = fx * sx + view.cx - 0.5, py = fy * sy + view.cy - 0.5;
      const reach = 2 * Math.log(255 * opacity) + 1e-4;
      const wide = Math.sqrt(reach * xx), high = Math.sqrt(reach * yy);
      const x0 = Math.max(0, Math.ceil(px - wide)), x1 = Math.min(width - 1, Math.floor(px + wide));
      const y0 = Math.max(0, Math.ceil(py - high)), y1 = Math.min(height - 1, Math.floor(py + high));
      if (x0 > x1 || y0 > y1) continue;
      const a = yy / det, b = -xy / det, d = xx / det;
      const length = Math.hypot(dx, dy, dz);
      this.colour(i, [dx / length, dy / length, dz / length], rgb);
      for (let y = y0; y <= y1; y++) {
        const ey = y - py;
        for (let x = x0; x <= x1; x++) {
          const at = y * width + x;
          const left = through[at];
          if (left < 1e-4) continue;
          const ex = x - px;
          const alpha = Math.min(
            opacity * Math.exp(-0.5 * (a * ex * ex + d * ey * ey) - b * ex * ey), ALPHA_MAX);
          if (alpha < ALPHA_MIN) continue;
          const weight = left * alpha;
          sums[3 * at] += weight * rgb[0];
          sums[3 * at + 1] += weight * rgb[1];
          sums[3 * at + 2] += weight * rgb[2];
          through[at] = left - weight;
        }
      }
    }
    const image = this.context.createImageData(width, height);
    for (let at = 0; at < width * height; at++) {
      for (let c = 0; c < 3; c++) {
        image.data[4 * at + c] = Math.round(
          255 * (sums[3 * at + c] + through[at] * background[c]));
      }
      image.data[4 * at + 3] = 255;
    }
    this.context.putImageData(image, 0, 0);
  }

  pixels(width, height) {
    return this.context.getImageData(0, 0, width, height).data;
  }
}

const KEYS = [
  ["Drag, or arrow keys", "rotate"],
  ["Right or Shift drag, two fingers, or Shift arrows", "shift"],
  ["Wheel, pinch, + and −", "nearer and farther; when flying: faster and slower"],
  ["W A S D, E Q", "move forward, left, back, right, up, down"],
  ["F", "orbit or fly"],
  ["V", "next photograph’s place"],
  ["R", "back to the start"],
  ["L", "all Gaussians, or fewer where they are far"],
  ["P", "save the picture"],
];

/** A viewer inside the element `root`. */
class SplatViewer {
  /** `draw`: "auto", "webgl" or "cpu"; `levels`: whether far parts are drawn with fewer Gaussians. */
  constructor(root, { draw = "auto", levels = true } = {}) {
    this.root = root;
    this.useLevels = levels;
    root.classList.add("splat-viewer");
    root.innerHTML = `
      <canvas tabindex="0" role="application" aria-roledescription="3D view"
        aria-label="3D scene. Arrow keys rotate, plus and minus change the distance, W A S D move."></canvas>
      <div class="splat-tools" role="toolbar" aria-label="View">
        <button type="button" data-do="fly" aria-pressed="false">Fly</button>
        <button type="button" data-do="nearer" aria-label="Nearer">+</button>
        <button type="button" data-do="farther" aria-label="Farther">−</button>
        <button type="button" data-do="view">Next view</button>
        <button type="button" data-do="reset">Reset</button>
        <button type="button" data-do="picture">Save picture</button>
        <button type="button" data-do="help" aria-expanded="false">Keys</button>
      </div>
      <dl class="splat-keys" hidden></dl>
      <p class="splat-status" role="status" aria-live="polite"></p>`;
    this.canvas = root.querySelector("canvas");
    this.status = root.querySelector(".splat-status");
    this.keys = root.querySelector(".splat-keys");
    for (const [key, meaning] of KEYS) {
      const term = document.createElement("dt"), text = document.createElement("dd");
      [term.textContent, text.textContent] = [key, meaning];
      this.keys.append(term, text);
    }
    this.painter = null;
    if (draw !== "cpu") {
      try {
        this.painter = new GlPainter(this.canvas);
      } catch (error) {
        if (draw === "webgl") throw error;
        // A canvas keeps its first context.
        const fresh = this.canvas.cloneNode(true);
        this.canvas.replaceWith(fresh);
        this.canvas = fresh;
      }
    }
    this.painter ??= new CpuPainter(this.canvas);
    this.held = new Set();
    this.pointers = new Map();
    this.listen();
  }

  say(text) {
    this.status.textContent = text;
  }

  /**
   * Shows a scene. `spz`: the file's bytes; `settings`: `cameras` (of cameras.json, one object
   * each), `background`, `near`, `lowpass`.
   */
  async load(spz, settings = {}) {
    const scene = await parseSpz(spz);
    if (scene.count === 0) throw new Error("The scene holds no Gaussian.");
    this.painter.load(scene);
    this.scene = scene;
    this.background = settings.background ?? [0, 0, 0];
    this.rules = { near: settings.near ?? 0.01, lowpass: settings.lowpass ?? 0.3 };
    const box = bounds(scene);
    const cameras = (settings.cameras ?? []).map(toViewer);
    this.cameras = cameras.length ? cameras : [wholeCamera(box)];
    const up = cameras.reduce((sum, c) => add(sum, column(c.rotation, 1), -1), [0, 0, 0]);
    this.up = unit(up) ?? [0, 1, 0];
    this.radius = Math.max(0.5 * Math.hypot(...add(box[1], box[0], -1)), 1e-3);
    this.view = 0;
    this.fly = false;
    this.root.querySelector("[data-do=fly]").setAttribute("aria-pressed", "false");
    this.root.querySelector("[data-do=view]").hidden = this.cameras.length < 2;
    this.levels = null;
    this.reset();
    this.drawn = scene.count;
    this.sayCount();
    // The levels are made after the first picture.
    setTimeout(() => this.makeLevels(scene).catch(() => { this.levels = null; }), 100);
  }

  /** Says the number of Gaussians drawn. */
  sayCount() {
    const [drawn, all] = [this.drawn, this.scene.count].map((n) => n.toLocaleString("en"));
    this.countText = `${drawn === all ? all : `${drawn} of ${all}`} Gaussians, drawn by ${this.painter.name}`;
    this.say(this.countText);
  }

  /** Makes the levels of a scene in the background, until another one is loaded. */
  async makeLevels(scene) {
    const pause = slices(() => this.scene === scene);
    const levels = await Levels.make(scene, pause);
    if (!levels || !await this.painter.extend(levels.scene, pause)) return;
    this.levels = levels;
    this.redraw();
  }

  /** Goes to the place of a photograph. */
  reset(view = this.view) {
    this.view = view;
    const home = this.cameras[view];
    this.home = home;
    this.rotation = [...home.rotation];
    this.eye = [...home.eye];
    const z = depths(this.scene, home);
    this.distance = z.length ? z[z.length >> 1] : this.radius;
    this.speed = 0.4 * this.radius;
    this.redraw();
  }

  forward() {
    return column(this.rotation, 2);
  }

  pivot() {
    return add(this.eye, this.forward(), this.distance);
  }

  /** Rotates by a drag, px of a picture `height` px high. */
  rotate(x, y, height = this.canvas.clientHeight) {
    const pivot = this.pivot();
    const scale = Math.PI / height;
    const elevation = Math.asin(Math.min(Math.max(dot(this.forward(), this.up), -1), 1));
    const limit = Math.max(89 * Math.PI / 180, Math.abs(elevation));
    const raised = Math.min(Math.max(elevation - scale * y, -limit), limit) - elevation;
    const turned = multiply(about(this.up, -scale * x), this.rotation);
    this.rotation = orthonormal(multiply(turned, about([1, 0, 0], raised)));
    if (!this.fly) this.eye = add(pivot, this.forward(), -this.distance);
    this.redraw();
  }

  pan(x, y) {
    const k = fitted(this.home, this.canvas.clientWidth, this.canvas.clientHeight);
    const shift = apply(this.rotation, [x / k.fx, y / k.fy, 0]);
    this.eye = add(this.eye, shift, -this.distance);
    this.redraw();
  }

  /** Steps of the wheel, positive nearer or faster. */
  wheel(steps) {
    const within = (v) => Math.min(Math.max(v, 1e-3 * this.radius), 1e3 * this.radius);
    if (this.fly) {
      this.speed = within(this.speed * 1.25 ** steps);
      return;
    }
    const pivot = this.pivot();
    this.distance = within(this.distance * 0.9 ** steps);
    this.eye = add(pivot, this.forward(), -this.distance);
    this.redraw();
  }

  move([right, up, forward], seconds) {
    let along = add(apply(this.rotation, [right, 0, forward]), this.up, up);
    const length = Math.hypot(...along);
    if (length > 1) along = along.map((c) => c / length);
    this.eye = add(this.eye, along, this.speed * seconds);
    this.redraw();
  }

  redraw() {
    if (this.pending || !this.scene) return;
    this.pending = true;
    requestAnimationFrame(() => {
      this.pending = false;
      this.paint();
      // The number is said at rest, and replaces no other message.
      clearTimeout(this.counting);
      this.counting = setTimeout(() => {
        if (this.status.textContent === this.countText) this.sayCount();
      }, 300);
    });
  }

  paint() {
    const ratio = this.painter instanceof GlPainter ? Math.min(window.devicePixelRatio || 1, 2) : 1;
    const width = Math.max(1, Math.round(ratio * this.canvas.clientWidth));
    const height = Math.max(1, Math.round(ratio * this.canvas.clientHeight));
    this.paintAt(fitted(this.home, width, height));
  }

  paintAt(intrinsics) {
    const { width, height } = intrinsics;
    if (this.canvas.width !== width) this.canvas.width = width;
    if (this.canvas.height !== height) this.canvas.height = height;
    const camera = { ...intrinsics, rotation: this.rotation, eye: this.eye };
    const view = projection(camera, this.rules);
    const chosen = this.useLevels && this.levels ? this.levels.select(view) : null;
    this.painter.draw(view, this.background, chosen);
    this.drawn = chosen ? chosen.length : this.scene.count;
  }

  /** The current view at the size of the photographs, as ImageData. */
  capture() {
    const { width, height } = this.home;
    this.paintAt(fitted(this.home, width, height));
    const data = new ImageData(new Uint8ClampedArray(this.painter.pixels(width, height)), width);
    this.redraw();
    return data;
  }

  savePicture() {
    const data = this.capture();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [data.width, data.height];
    canvas.getContext("2d").putImageData(data, 0, 0);
    canvas.toBlob((blob) => saveBlob(blob, "view.png"), "image/png");
  }

  act(name) {
    if (!this.scene) return;
    const button = this.root.querySelector(`[data-do=${name}]`);
    switch (name) {
      case "fly":
        this.fly = !this.fly;
        button.setAttribute("aria-pressed", String(this.fly));
        this.say(this.fly ? "Flying: drags turn the view." : "Orbiting: drags turn the scene.");
        break;
      case "nearer": this.fly ? this.move([0, 0, 1], 0.25) : this.wheel(1); break;
      case "farther": this.fly ? this.move([0, 0, -1], 0.25) : this.wheel(-1); break;
      case "view":
        this.reset((this.view + 1) % this.cameras.length);
        this.say(`The place of photograph ${this.view + 1} of ${this.cameras.length}.`);
        break;
      case "reset": this.reset(); break;
      case "levels":
        this.useLevels = !this.useLevels;
        this.paint();
        this.sayCount();
        break;
      case "picture": this.savePicture(); break;
      case "help":
        this.keys.hidden = !this.keys.hidden;
        button.setAttribute("aria-expanded", String(!this.keys.hidden));
        break;
    }
  }

  listen() {
    const { canvas, pointers } = this;
    this.root.querySelector(".splat-tools").addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (button) this.act(button.dataset.do);
    });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true });
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    const release = (event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before || !this.scene) return;
      const now = [event.clientX, event.clientY];
      const [x, y] = [now[0] - before[0], now[1] - before[1]];
      if (pointers.size === 2) {
        const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
        const gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
        this.wheel(Math.log(gap(before) / Math.max(gap(now), 1)) / Math.log(0.9));
        this.pan(0.5 * x, 0.5 * y);
      } else if (event.shiftKey || event.buttons & 6) {
        this.pan(x, y);
      } else {
        this.rotate(x, y);
      }
      pointers.set(event.pointerId, now);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (this.scene) this.wheel(-event.deltaY / (event.deltaMode === 0 ? 100 : 3));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.keyDown(event));
    canvas.addEventListener("keyup", (event) => this.held.delete(event.code));
    canvas.addEventListener("blur", () => this.held.clear());
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  keyDown(event) {
    if (!this.scene || event.ctrlKey || event.altKey || event.metaKey) return;
    const step = 24;
    const arrows = {
      ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step],
    };
    const actions = {
      KeyF: "fly", KeyV: "view", KeyR: "reset", Home: "reset", KeyP: "picture", KeyL: "levels", KeyH: "help",
    };
    if (arrows[event.code]) {
      event.shiftKey ? this.pan(...arrows[event.code]) : this.rotate(...arrows[event.code], 512);
    } else if (event.key === "+" || event.key === "=") {
      this.wheel(1);
    } else if (event.key === "-") {
      this.wheel(-1);
    } else if (actions[event.code]) {
      if (!event.repeat) this.act(actions[event.code]);
    } else if (/^Key[WASDEQ]$/.test(event.code)) {
      this.held.add(event.code);
      this.walk();
    } else {
      return;
    }
    event.preventDefault();
  }

  /** Moves while keys are held. */
  walk() {
    if (this.walking) return;
    this.walking = true;
    let before = performance.now();
    const frame = (now) => {
      const key = (code) => Number(this.held.has(code));
      const along = [
        key("KeyD") - key("KeyA"), key("KeyE") - key("KeyQ"), key("KeyW") - key("KeyS"),
      ];
      this.walking = this.held.size > 0;
      if (!this.walking) return;
      this.move(along, Math.min(Math.max((now - before) / 1000, 0), 0.1));
      before = now;
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }
}

/** Offers a blob as a download. */
function saveBlob(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
