// The range of views that the photographs of a scene support.
//
// Inside lie the paths between photographs that look the same way, and around each photograph the directions in
// which the picture stays covered.
"use strict";

/** Side of the pictures in which coverage is measured, pixels, and the most Gaussians that are drawn there. */
const COVERAGE_SIDE = 40, COVERAGE_GAUSSIANS = 12000;
/** Largest share of the picture that may lose its cover, with weights that fall from the middle to the edge. */
const UNCOVERED_MAX = 0.045;
/** Directions of a turn for which the reach is measured, and the photographs around which it is. */
const DIRECTIONS = 8, MEASURED = 6;
const DEGREE = Math.PI / 180;
/** Least reach, and the largest one by the angle between the photographs: their depths agree over that angle. */
const REACH_MIN = 4 * DEGREE, REACH_MAX = 25 * DEGREE, REACH_ALONE = 6 * DEGREE;
/** Largest angle between the viewing directions of photographs with a path between them. */
const PATH_ANGLE = 60 * DEGREE;
/** How far a view may come nearer, as a share of the median depth, and stand back. */
const NEARER = 0.6, FARTHER = 0.4;

const angleOf = (a, b) => {
  const [u, v] = [unit(a), unit(b)];
  return u && v ? Math.acos(Math.min(Math.max(dot(u, v), -1), 1)) : 0;
};
const mix = (a, b, t) => a.map((v, k) => v + t * (b[k] - v));

/** Views that the photographs support. */
class ViewRange {
  /** The range of `cameras`, those of the photographs; null without one that sees the scene. */
  static of(scene, cameras) {
    const sites = [];
    for (const camera of cameras) {
      const z = depths(scene, camera, Math.ceil(scene.count / COVERAGE_GAUSSIANS));
      if (z.length) sites.push(new Site(camera, z[z.length >> 1], z[Math.floor(0.05 * z.length)]));
    }
    return sites.length ? new ViewRange(scene, sites) : null;
  }

  constructor(scene, sites) {
    this.scene = scene;
    this.sites = sites;
    // Photographs that look the same way, and from one place to the next.
    this.paths = [];
    let span = 0;
    sites.forEach((a, i) => {
      this.paths.push([a, a]);
      for (const b of sites.slice(i + 1)) {
        const apart = Math.hypot(...add(b.eye, a.eye, -1));
        if (angleOf(a.forward, b.forward) > PATH_ANGLE || apart > 1.5 * Math.min(a.depth, b.depth)) continue;
        this.paths.push([a, b]);
        const aim = add(a.eye, a.forward, a.depth);
        span = Math.max(span, angleOf(add(a.eye, aim, -1), add(b.eye, aim, -1)));
      }
    });
    this.most = Math.min(REACH_ALONE + 0.35 * span, REACH_MAX);
  }

  /** The place on the paths that is next to `eye`: a mixture of two photographs. */
  nearest(eye) {
    let best = null;
    for (const [a, b] of this.paths) {
      const way = add(b.eye, a.eye, -1), length = dot(way, way);
      const t = length > 0 ? Math.min(Math.max(dot(add(eye, a.eye, -1), way) / length, 0), 1) : 0;
      const place = add(a.eye, way, t), apart = Math.hypot(...add(eye, place, -1));
      if (!best || apart < best.apart) best = { a, b, t, place, apart };
    }
    const { a, b, t } = best;
    const of = (name) => a[name] + t * (b[name] - a[name]);
    return {
      eye: best.place, forward: unit(mix(a.forward, b.forward, t)) ?? a.forward, right: mix(a.right, b.right, t),
      down: mix(a.down, b.down, t), depth: of("depth"), front: of("front"), half: of("half"),
      reach: mix(a.reach, b.reach, t),
    };
  }

  /** How far a view is from the photographs: 0 at one or between two, 1 at the limit. */
  excess(eye, forward) {
    const site = this.nearest(eye);
    const offset = add(eye, site.eye, -1);
    const along = dot(offset, site.forward);
    const aim = add(eye, forward, Math.max(site.depth - along, 0.1 * site.depth));
    const turned = angleOf(add(eye, aim, -1), add(site.eye, aim, -1));
    const side = turned / reachAt(site.reach, dot(offset, site.right), dot(offset, site.down));
    const deep = along > 0
      ? along / Math.min(NEARER * site.depth, 0.8 * site.front) : -along / (FARTHER * site.depth);
    // The middle of the picture stays in the middle half of a photograph.
    const gaze = angleOf(add(aim, site.eye, -1), site.forward) / (0.5 * site.half);
    return Math.max(Math.hypot(side, deep), gaze);
  }

  /** Mean reach at a place, radians. */
  reach(eye) {
    const { reach } = this.nearest(eye);
    return reach.reduce((sum, r) => sum + r, 0) / reach.length;
  }

  /** Measures the reach around the photographs by what stays covered; false where `pause` ends the work. */
  async measure(pause) {
    const every = Math.max(1, Math.ceil(this.sites.length / MEASURED));
    let reach = null;
    for (const [i, site] of this.sites.entries()) {
      if (i % every === 0) {
        const cover = new Coverage(this.scene, site);
        reach = [];
        for (let k = 0; k < DIRECTIONS; k++) {
          let [low, high] = [REACH_MIN, this.most];
          if (cover.lost(k, high) <= UNCOVERED_MAX) low = high;
          while (high - low > 0.7 * DEGREE) {
            if (!await pause()) return false;
            const middle = 0.5 * (low + high);
            if (cover.lost(k, middle) <= UNCOVERED_MAX) low = middle;
            else high = middle;
          }
          reach.push(low);
          if (!await pause()) return false;
        }
      }
      site.reach = reach;
    }
    return true;
  }
}

/** Reach in the direction of an offset to the right and down. */
function reachAt(reach, x, y) {
  const at = (Math.atan2(y, x) / (2 * Math.PI) + 1) * DIRECTIONS, k = Math.floor(at);
  return reach[k % DIRECTIONS] + (at - k) * (reach[(k + 1) % DIRECTIONS] - reach[k % DIRECTIONS]);
}

/** A photograph of the range. `depth` is the median depth there, `front` that of the nearest things. */
class Site {
  constructor(camera, depth, front) {
    this.camera = camera;
    this.eye = camera.eye;
    [this.right, this.down, this.forward] = [0, 1, 2].map((c) => column(camera.rotation, c));
    this.depth = depth;
    this.front = front;
    this.half = Math.atan(0.5 * Math.max(camera.width / camera.fx, camera.height / camera.fy));
    /** Largest turn about the middle of the scene for each of the directions; the least until it is measured. */
    this.reach = Array(DIRECTIONS).fill(REACH_MIN);
  }

  /** The camera, turned about the middle of the scene: its eye moves in direction `k`. */
  turned(k, angle) {
    const direction = 2 * Math.PI * k / DIRECTIONS;
    // Right of the camera is a turn about its y axis by a negative angle.
    const axis = unit(add(this.down.map((v) => -v * Math.cos(direction)), this.right, Math.sin(direction)));
    const rotation = multiply(about(axis, angle), this.camera.rotation);
    const pivot = add(this.eye, this.forward, this.depth);
    return { rotation, eye: add(pivot, column(rotation, 2), -this.depth) };
  }
}

/** Transmittance of views of a scene in small pictures, from a sample of its Gaussians. */
class Coverage {
  constructor(scene, site) {
    this.scene = scene;
    this.site = site;
    const { width, height } = site.camera;
    const scale = COVERAGE_SIDE / Math.max(width, height);
    this.lens = fitted(site.camera, Math.max(Math.round(scale * width), 1), Math.max(Math.round(scale * height), 1));
    this.step = Math.max(1, Math.ceil(scene.count / COVERAGE_GAUSSIANS));
    const bell = (at, side) => Math.sin(Math.PI * (at + 0.5) / side);
    const { width: w, height: h } = this.lens;
    this.weights = Float32Array.from({ length: w * h }, (_, at) => bell(at % w, w) * bell(Math.floor(at / w), h));
    this.weight = this.weights.reduce((sum, v) => sum + v, 0);
    this.home = this.through(site.camera);
  }

  /** Share of the picture whose cover is lost by a turn. */
  lost(k, angle) {
    const through = this.through(this.site.turned(k, angle));
    let sum = 0;
    through.forEach((v, at) => { sum += this.weights[at] * Math.max(v - this.home[at], 0); });
    return sum / this.weight;
  }

  /** Transmittance of each pixel: optical depths add up in any order. */
  through({ rotation: r, eye }) {
    const { means, covariances, opacities, count } = this.scene;
    const { width, height, fx, fy, cx, cy } = this.lens;
    const sums = new Float32Array(width * height);
    const near = 0.02 * this.site.depth;
    for (let i = 0; i < count; i += this.step) {
      const dx = means[3 * i] - eye[0], dy = means[3 * i + 1] - eye[1], dz = means[3 * i + 2] - eye[2];
      const z = r[2] * dx + r[5] * dy + r[8] * dz;
      if (!(z > near) || opacities[i] < ALPHA_MIN) continue;
      const px = fx * (r[0] * dx + r[3] * dy + r[6] * dz) / z + cx - 0.5;
      const py = fy * (r[1] * dx + r[4] * dy + r[7] * dz) / z + cy - 0.5;
      // The trace stands for the footprint: its mean variance in two of three directions.
      const c = 6 * i, size = (covariances[c] + covariances[c + 3] + covariances[c + 5]) / 2;
      const variance = Math.min(size * fx * fx / (z * z), 16), spread = variance + LOWPASS;
      const depth = -this.step * Math.log1p(-Math.min(opacities[i], 0.99)) * variance / spread;
      const reach = 3 * Math.sqrt(spread);
      const x1 = Math.min(width - 1, Math.floor(px + reach)), y1 = Math.min(height - 1, Math.floor(py + reach));
      for (let y = Math.max(0, Math.ceil(py - reach)); y <= y1; y++) {
        for (let x = Math.max(0, Math.ceil(px - reach)); x <= x1; x++) {
          sums[y * width + x] += depth * Math.exp(-0.5 * ((x - px) ** 2 + (y - py) ** 2) / spread);
        }
      }
    }
    return sums.map((depth) => Math.exp(-depth));
  }
}
