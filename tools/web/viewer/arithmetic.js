// Constants of the drawing, vectors, matrices and cameras of the viewer.
//
// World axes here are those of .spz: x right, y up, z backward. Camera axes are OpenCV's: x right,
// y down, z forward.
"use strict";

const ALPHA_MIN = 1 / 255;
const ALPHA_MAX = 0.999;
const SH_C0 = 0.28209479177387814;
const LOWPASS = 0.3;
/** Longest time without a pause while levels are made, ms. */
const SLICE = 8;
/** Coefficients of degree 1 to 3, in the order of `basis`. */
const SH = [
  -0.4886025119029199, 0.4886025119029199, -0.4886025119029199,
  1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792,
  0.5462742152960396, -0.5900435899266435, 2.890611442640554, -0.4570457994644658,
  0.3731763325901154, -0.4570457994644658, 1.445305721320277, -0.5900435899266435,
];

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
  const { width, height, fx, fy, cx, cy, name } = camera;
  return { width, height, fx, fy, cx, cy, rotation, eye, name };
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
