// Draws Gaussians on the processor.
"use strict";

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

  /** Longest side of a picture, px: that of a canvas in common browsers. */
  get sideMax() {
    return 8192;
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

  draw(view, background, chosen, fade = 0) {
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
    const fill = filled(sums, through, width, height, background);
    for (let at = 0; at < width * height; at++) {
      const x = (2 * (at % width) + 1) / width - 1, y = (2 * Math.floor(at / width) + 1) / height - 1;
      const faded = fade * Math.min(0.25 + x * x + y * y, 1);
      for (let c = 0; c < 3; c++) {
        const own = sums[3 * at + c] + through[at] * fill[3 * at + c];
        image.data[4 * at + c] = Math.round(255 * (own + faded * (background[c] - own)));
      }
      image.data[4 * at + 3] = 255;
    }
    this.context.putImageData(image, 0, 0);
  }

  pixels(width, height) {
    return this.context.getImageData(0, 0, width, height).data;
  }
}

/** Colours that fill a picture where little covers it: the surroundings, from the picture at half the size on. */
function filled(sums, through, width, height, background) {
  const w = Math.ceil(width / 2), h = Math.ceil(height / 2);
  const halfSums = new Float32Array(3 * w * h), halfThrough = new Float32Array(w * h);
  for (let y = 0; y < h; y++) {
    for (let x = 0; x < w; x++) {
      const to = y * w + x;
      for (let k = 0; k < 4; k++) {
        const at = Math.min(2 * y + (k >> 1), height - 1) * width + Math.min(2 * x + (k & 1), width - 1);
        halfThrough[to] += 0.25 * through[at];
        for (let c = 0; c < 3; c++) halfSums[3 * to + c] += 0.25 * sums[3 * at + c];
      }
    }
  }
  const under = w * h > 1 ? filled(halfSums, halfThrough, w, h, background) : background;
  for (let at = 0; at < 3 * w * h; at++) halfSums[at] += halfThrough[Math.floor(at / 3)] * under[at];
  const out = new Float32Array(3 * width * height);
  for (let y = 0; y < height; y++) {
    const v = Math.min(Math.max(0.5 * y - 0.25, 0), h - 1), y0 = Math.floor(v), y1 = Math.min(y0 + 1, h - 1);
    for (let x = 0; x < width; x++) {
      if (through[y * width + x] < 0.002) continue;
      const u = Math.min(Math.max(0.5 * x - 0.25, 0), w - 1), x0 = Math.floor(u), x1 = Math.min(x0 + 1, w - 1);
      for (let c = 0; c < 3; c++) {
        const of = (column, row) => halfSums[3 * (row * w + column) + c];
        const above = of(x0, y0) + (u - x0) * (of(x1, y0) - of(x0, y0));
        const below = of(x0, y1) + (u - x0) * (of(x1, y1) - of(x0, y1));
        out[3 * (y * width + x) + c] = above + (v - y0) * (below - above);
      }
    }
  }
  return out;
}
