// Levels of detail: fewer Gaussians where they are far.
"use strict";

/** The rules of src/scene/levels.rs and src/finish/merge.rs. */
const BLOCK = 1024, CELL_PX = 1, SIGMA_MAX = 1, SHARE_MAX = 0.5, PIXEL_SIDES = 1.4;
const MERGED_OPACITY_MAX = 0.9999, DENSE_OPACITY = 0.35;
/** Bits of a coordinate on the curve: a code is a whole number below 2 to the power of 53. */
const CURVE_BITS = 17;

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
