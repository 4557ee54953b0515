//! A naive rasterizer in `f64`: every splat at every pixel, one global sort, no
//! tiles, no bounds. Written from the conventions' text alone; shares no code with
//! the kernels. Never to be deleted: it is the bottom of the ladder of oracles.

use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{Convention, RasterOptions, ShBasis, ShDirection};

/// How near, relatively, a decision may be before its pixel counts as boundary.
const BAND: f64 = 1e-3;

/// Shape of one splat.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    /// Quaternion wxyz and σ.
    Quat([f32; 4], [f32; 3]),
    /// World covariance 00, 01, 02, 11, 12, 22.
    Cov6([f32; 6]),
}

/// One splat with everything it needs.
#[derive(Clone, Debug)]
pub struct Splat {
    pub mean: [f32; 3],
    pub shape: Shape,
    pub opacity: f32,
    /// `[D][3]`.
    pub sh: Vec<[f32; 3]>,
    pub gain: f32,
    pub residual: [f32; 3],
    /// Mean of the parent's children, for [`ShDirection::Parent`].
    pub parent_mean: [f64; 3],
}

/// A view that the oracle renders.
pub struct Picture {
    pub rgb: Vec<f64>,
    pub alpha: Vec<f64>,
    pub depth_sum: Vec<f64>,
    /// True where a threshold at this pixel is nearer than [`BAND`].
    pub boundary: Vec<bool>,
}

struct Flat {
    uv: [f64; 2],
    conic: [f64; 3],
    opacity: f64,
    rgb: [f64; 3],
    z: f64,
    /// Pixels [x0, x1) × [y0, y1) in which it exists.
    tiles: Option<[i64; 4]>,
    /// The tile cut itself hangs on rounding.
    shaky: bool,
}

type M3 = [[f64; 3]; 3];

fn mul(a: &M3, b: &M3) -> M3 {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum::<f64>()))
}

fn transpose(a: &M3) -> M3 {
    std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
}

fn covariance(shape: Shape) -> M3 {
    match shape {
        Shape::Cov6(c) => {
            let [a, b, c, d, e, f] = c.map(f64::from);
            [[a, b, c], [b, d, e], [c, e, f]]
        }
        Shape::Quat(q, s) => {
            let q = q.map(f64::from);
            let n = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            let [w, x, y, z] = q.map(|v| v / n);
            let r = [
                [1. - 2. * (y * y + z * z), 2. * (x * y - w * z), 2. * (x * z + w * y)],
                [2. * (x * y + w * z), 1. - 2. * (x * x + z * z), 2. * (y * z - w * x)],
                [2. * (x * z - w * y), 2. * (y * z + w * x), 1. - 2. * (x * x + y * y)],
            ];
            let s = s.map(f64::from);
            let rs: M3 = std::array::from_fn(|i| std::array::from_fn(|j| r[i][j] * s[j]));
            mul(&rs, &transpose(&rs))
        }
    }
}

/// Associated Legendre P_l^m(z) without the Condon-Shortley sign, by recurrence.
fn legendre(l: usize, m: usize, z: f64) -> f64 {
    let s = (1.0 - z * z).max(0.0).sqrt();
    let mut pmm = 1.0;
    for k in 1..=m {
        pmm *= (2 * k - 1) as f64 * s;
    }
    if l == m {
        return pmm;
    }
    let mut below = pmm;
    let mut here = z * (2 * m + 1) as f64 * pmm;
    for k in m + 2..=l {
        let next = ((2 * k - 1) as f64 * z * here - (k + m - 1) as f64 * below) / (k - m) as f64;
        (below, here) = (here, next);
    }
    here
}

/// Real SH of degree ≤ 4 with the Condon-Shortley sign, from the definition.
fn spherical_harmonics([x, y, z]: [f64; 3]) -> [f64; 25] {
    let phi = y.atan2(x);
    let mut out = [0.0; 25];
    for l in 0..=4usize {
        for m in 0..=l {
            let ratio: f64 = (l - m + 1..=l + m).map(|v| v as f64).product();
            let norm = ((2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) / ratio).sqrt();
            let sign = if m % 2 == 0 { 1.0 } else { -1.0 };
            let p = sign * norm * legendre(l, m, z);
            let (s, c) = (m as f64 * phi).sin_cos();
            if m == 0 {
                out[l * l + l] = p;
            } else {
                out[l * l + l + m] = std::f64::consts::SQRT_2 * p * c;
                out[l * l + l - m] = std::f64::consts::SQRT_2 * p * s;
            }
        }
    }
    out
}

fn colour(splat: &Splat, eye: [f64; 3], options: &RasterOptions) -> [f64; 3] {
    let from = match options.sh_direction {
        ShDirection::Child => splat.mean.map(f64::from),
        ShDirection::Parent => splat.parent_mean,
        ShDirection::Colour => {
            return std::array::from_fn(|c| {
                f64::from(splat.gain) * f64::from(splat.sh[0][c]) + f64::from(splat.residual[c])
            });
        }
    };
    let d = [from[0] - eye[0], from[1] - eye[1], from[2] - eye[2]];
    let n = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    let d = d.map(|v| v / n);
    let (functions, used) = match options.sh_basis {
        ShBasis::Standard => (spherical_harmonics(d), 25),
        ShBasis::Mvsplat => {
            let mut y = spherical_harmonics([d[2], d[0], d[1]]);
            y[14] =
                (105.0 / (16.0 * std::f64::consts::PI)).sqrt() * d[2] * (d[2] * d[2] - d[0] * d[0]);
            (y, 16)
        }
    };
    let used = used.min((options.sh_degree + 1).pow(2));
    std::array::from_fn(|c| {
        let sum: f64 =
            splat.sh.iter().zip(functions).take(used).map(|(h, y)| f64::from(h[c]) * y).sum();
        (0.5 + f64::from(splat.gain) * sum + f64::from(splat.residual[c])).max(0.0)
    })
}

fn flatten(splat: &Splat, camera: &Camera, options: &RasterOptions) -> Option<Flat> {
    let k = camera.intrinsics();
    let (w, h) = (k.width as f64, k.height as f64);
    let pose = camera.world_from_camera().as_dmat4();
    let r: M3 = std::array::from_fn(|i| std::array::from_fn(|j| pose.col(j)[i]));
    let eye = [pose.w_axis.x, pose.w_axis.y, pose.w_axis.z];
    let m = splat.mean.map(f64::from);
    let d = [m[0] - eye[0], m[1] - eye[1], m[2] - eye[2]];
    let p: [f64; 3] = std::array::from_fn(|i| (0..3).map(|j| r[j][i] * d[j]).sum());
    let near = f64::from(options.near);
    let mvsplat = options.convention == Convention::Mvsplat;
    // Thresholds as the f32 options give them.
    let cull = if mvsplat { f64::from(0.2f32 * options.near) } else { near };
    if p[2] <= cull {
        return None;
    }
    let (fx, fy) = (f64::from(k.fx), f64::from(k.fy));
    let (cx, cy) = (f64::from(k.cx), f64::from(k.cy));
    let (sx, sy) = (p[0] / p[2], p[1] / p[2]);
    let (uv, tx, ty) = if mvsplat {
        assert!(cx == w / 2.0 && cy == h / 2.0, "the oracle knows centred frusta only");
        let (lx, ly) = (1.3 * w / (2.0 * fx), 1.3 * h / (2.0 * fy));
        let z = p[2] + 1e-7 * near;
        let uv = [fx * p[0] / z + w / 2.0 - 0.5, fy * p[1] / z + h / 2.0 - 0.5];
        (uv, sx.clamp(-lx, lx), sy.clamp(-ly, ly))
    } else {
        let (mx, my) = (0.3 * w / (2.0 * fx), 0.3 * h / (2.0 * fy));
        (
            [fx * sx + cx - 0.5, fy * sy + cy - 0.5],
            sx.clamp(-(cx / fx + mx), (w - cx) / fx + mx),
            sy.clamp(-(cy / fy + my), (h - cy) / fy + my),
        )
    };
    let j = [[fx / p[2], 0.0, -fx * tx / p[2]], [0.0, fy / p[2], -fy * ty / p[2]]];
    let in_camera = mul(&mul(&transpose(&r), &covariance(splat.shape)), &r);
    let entry = |a: usize, b: usize| -> f64 {
        (0..3).map(|i| (0..3).map(|l| j[a][i] * in_camera[i][l] * j[b][l]).sum::<f64>()).sum()
    };
    let (xx0, xy, yy0) = (entry(0, 0), entry(0, 1), entry(1, 1));
    let lowpass = f64::from(options.lowpass);
    let (xx, yy) = (xx0 + lowpass, yy0 + lowpass);
    let det = xx * yy - xy * xy;
    let mut opacity = f64::from(splat.opacity);
    if options.antialiased {
        opacity *= ((xx0 * yy0 - xy * xy) / det).max(0.0).sqrt();
    }
    let (tiles, shaky) = if mvsplat { cut(uv, [w, h], xx, yy, det) } else { (None, false) };
    Some(Flat {
        uv,
        conic: [yy / det, -xy / det, xx / det],
        opacity,
        rgb: colour(splat, eye, options),
        z: p[2],
        tiles,
        shaky,
    })
}

/// The 16×16 tiles of a splat in pixels, and whether they hang on rounding.
fn cut(uv: [f64; 2], size: [f64; 2], xx: f64, yy: f64, det: f64) -> (Option<[i64; 4]>, bool) {
    let mid = (xx + yy) / 2.0;
    let exact = 3.0 * (mid + (mid * mid - det).max(0.1).sqrt()).sqrt();
    let tiles = |radius: f64, nudge: f64| -> [i64; 4] {
        let r = radius.ceil();
        let to_px = |axis: usize, v: f64| {
            let v = v + nudge * (1.0 + v.abs());
            ((v / 16.0).trunc().clamp(0.0, (size[axis] / 16.0).ceil()) * 16.0) as i64
        };
        [
            to_px(0, uv[0] - r),
            to_px(1, uv[1] - r),
            to_px(0, uv[0] + r + 15.0),
            to_px(1, uv[1] + r + 15.0),
        ]
    };
    let rect = tiles(exact, 0.0);
    let shaky = [-1e-5, 1e-5]
        .into_iter()
        .any(|e| tiles(exact * (1.0 + e), 0.0) != rect || tiles(exact, e) != rect);
    (Some(rect), shaky)
}

/// Renders `splats`, all of them finite.
pub fn render(splats: &[Splat], camera: &Camera, options: &RasterOptions) -> Picture {
    let mut flat: Vec<Flat> = splats.iter().filter_map(|s| flatten(s, camera, options)).collect();
    flat.sort_by(|a, b| a.z.total_cmp(&b.z));
    let (w, h) = (camera.intrinsics().width, camera.intrinsics().height);
    let mvsplat = options.convention == Convention::Mvsplat;
    let cap = if mvsplat { 0.99 } else { 0.999 };
    let mut out = Picture {
        rgb: vec![0.0; 3 * w * h],
        alpha: vec![0.0; w * h],
        depth_sum: vec![0.0; w * h],
        boundary: vec![false; w * h],
    };
    for pixel in 0..w * h {
        let (x, y) = ((pixel % w) as i64, (pixel / w) as i64);
        let (mut t, mut rgb, mut depth) = (1.0f64, [0.0f64; 3], 0.0f64);
        let mut last = None;
        for f in &flat {
            let (dx, dy) = (x as f64 - f.uv[0], y as f64 - f.uv[1]);
            let [a, b, c] = f.conic;
            let sigma = (a * dx * dx + c * dy * dy) / 2.0 + b * dx * dy;
            let raw = f.opacity * (-sigma).exp();
            let near_rim = (raw * 255.0 - 1.0).abs() < BAND;
            out.boundary[pixel] |= near_rim || (f.shaky && raw * 255.0 > 1.0 - BAND);
            let inside =
                f.tiles.is_none_or(|[x0, y0, x1, y1]| x0 <= x && x < x1 && y0 <= y && y < y1);
            if raw < 1.0 / 255.0 || !inside {
                continue;
            }
            // Two splats so close in depth that f32 may swap them.
            out.boundary[pixel] |=
                last.is_some_and(|z: f64| z != f.z && (f.z - z).abs() < 1e-6 * f.z);
            last = Some(f.z);
            let alpha = raw.min(cap);
            let rest = t * (1.0 - alpha);
            out.boundary[pixel] |= (rest / 1e-4 - 1.0).abs() < BAND;
            if (mvsplat && rest < 1e-4) || (!mvsplat && rest <= 1e-4) {
                break;
            }
            for (sum, c) in rgb.iter_mut().zip(f.rgb) {
                *sum += t * alpha * c;
            }
            depth += t * alpha * f.z;
            t = rest;
        }
        for (c, sum) in rgb.into_iter().enumerate() {
            out.rgb[3 * pixel + c] = sum + t * f64::from(options.background[c]);
        }
        out.alpha[pixel] = 1.0 - t;
        out.depth_sum[pixel] = depth;
    }
    out
}
