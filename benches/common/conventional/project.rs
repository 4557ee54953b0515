//! Projection of one splat and its gradient in scalar `f32`: EWA projection (3DGS, section 4;
//! gsplat's limits of the Jacobian) and colour by SH.

#![expect(clippy::needless_range_loop, reason = "plain loops, as such programs have them")]

use super::sh;
use subsplat_kernels::camera::Camera;

type V3 = [f32; 3];

/// Rendered splats. Splat i uses SH set i / (N / P).
#[derive(Clone, Copy)]
pub struct Splats<'a> {
    /// `[N, 11]`: mean, quaternion wxyz, σ, opacity.
    pub rows: &'a [f32],
    /// `[P, D, 3]`.
    pub sh: &'a [f32],
    /// `[N]`, or empty for 1.
    pub gain: &'a [f32],
    /// Degree that `sh` stores and that is evaluated.
    pub sh_degree: usize,
}

impl Splats<'_> {
    /// Returns N.
    pub fn len(&self) -> usize {
        self.rows.len() / 11
    }

    fn set(&self) -> usize {
        3 * (self.sh_degree + 1) * (self.sh_degree + 1)
    }

    /// Returns the offset of the SH set of splat `i`.
    pub fn sh_at(&self, i: usize) -> usize {
        let children = self.len() / (self.sh.len() / self.set());
        i / children * self.set()
    }

    fn gain(&self, i: usize) -> f32 {
        self.gain.get(i).copied().unwrap_or(1.0)
    }
}

/// Options of one call.
#[derive(Clone, Copy)]
pub struct Options {
    /// Minimum camera z.
    pub near: f32,
    /// Low-pass, px².
    pub lowpass: f32,
    /// Whether opacities are scaled by √(det Σ / det(Σ + low-pass)).
    pub antialiased: bool,
    /// RGB.
    pub background: V3,
    /// Half side of a splat's box in σ of its longer axis. Most programs use 3; from √(2·ln 255)
    /// = 3.33 on, no pixel of alpha ≥ 1/255 is cut.
    pub box_sigmas: f32,
}

/// A projected splat; `radius` 0 where it is dropped.
#[derive(Clone, Copy, Default)]
pub struct Projected {
    pub uv: [f32; 2],
    pub conic: V3,
    pub opacity: f32,
    pub rgb: V3,
    pub z: f32,
    pub radius: f32,
}

/// Gradients with respect to a [`Projected`].
#[derive(Clone, Copy, Default)]
pub struct ProjectedGrad {
    pub uv: [f32; 2],
    pub conic: V3,
    pub opacity: f32,
    pub rgb: V3,
}

/// Gradients with respect to [`Splats`] and the background.
#[derive(Clone, Default)]
pub struct Gradients {
    pub rows: Vec<f32>,
    pub sh: Vec<f32>,
    pub gain: Vec<f32>,
    pub background: V3,
}

fn dot(a: V3, b: V3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Rows of the rotation matrix of a unit quaternion.
fn rotation([w, x, y, z]: [f32; 4]) -> [V3; 3] {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// Gradient of [`rotation`] with respect to the unit quaternion.
fn rotation_backward([w, x, y, z]: [f32; 4], g: &[V3; 3]) -> [f32; 4] {
    [
        2.0 * (x * (g[2][1] - g[1][2]) + y * (g[0][2] - g[2][0]) + z * (g[1][0] - g[0][1])),
        2.0 * (y * (g[0][1] + g[1][0]) + z * (g[0][2] + g[2][0]) + w * (g[2][1] - g[1][2]))
            - 4.0 * x * (g[1][1] + g[2][2]),
        2.0 * (x * (g[0][1] + g[1][0]) + z * (g[1][2] + g[2][1]) + w * (g[0][2] - g[2][0]))
            - 4.0 * y * (g[0][0] + g[2][2]),
        2.0 * (x * (g[0][2] + g[2][0]) + y * (g[1][2] + g[2][1]) + w * (g[1][0] - g[0][1]))
            - 4.0 * z * (g[0][0] + g[1][1]),
    ]
}

/// A camera in the form of the loops below.
pub struct View {
    /// Rows of the rotation from world to camera.
    rows: [V3; 3],
    eye: V3,
    focal: [f32; 2],
    centre: [f32; 2],
    limit: [[f32; 2]; 2],
    options: Options,
    pub size: [usize; 2],
}

/// Intermediate values of one splat for projection and gradient.
struct Shape {
    p: V3,
    slope: [f32; 2],
    clamped: [bool; 2],
    unit: [f32; 4],
    norm: f32,
    rotation: [V3; 3],
    scale: V3,
    /// J·W, 2×3.
    a: [V3; 2],
    /// J·W·R·S, 2×3.
    m: [V3; 2],
    /// 2-D covariance without the low-pass: xx, xy, yy.
    cov: V3,
}

/// Determinant of the symmetric matrix (xx, xy, yy).
fn det([xx, xy, yy]: V3) -> f32 {
    xx * yy - xy * xy
}

impl View {
    pub fn new(camera: &Camera, options: Options) -> Self {
        let k = camera.intrinsics();
        let r = camera.rotation();
        let limit = |side: usize, f: f32, c: f32| {
            let margin = 0.3 * 0.5 * side as f32 / f;
            [-(c / f) - margin, (side as f32 - c) / f + margin]
        };
        Self {
            rows: [r.x_axis.to_array(), r.y_axis.to_array(), r.z_axis.to_array()],
            eye: camera.position().to_array(),
            focal: [k.fx, k.fy],
            centre: [k.cx, k.cy],
            limit: [limit(k.width, k.fx, k.cx), limit(k.height, k.fy, k.cy)],
            options,
            size: [k.width, k.height],
        }
    }

    pub fn background(&self) -> V3 {
        self.options.background
    }

    fn shape(&self, row: &[f32]) -> Option<Shape> {
        let d = [row[0] - self.eye[0], row[1] - self.eye[1], row[2] - self.eye[2]];
        let p = [dot(self.rows[0], d), dot(self.rows[1], d), dot(self.rows[2], d)];
        if p[2] <= self.options.near {
            return None;
        }
        let q = [row[3], row[4], row[5], row[6]];
        let norm = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
        let unit = q.map(|v| v / norm);
        let r = rotation(unit);
        let scale = [row[7], row[8], row[9]];
        let (mut slope, mut clamped) = ([0.0; 2], [false; 2]);
        let (mut a, mut m) = ([[0.0; 3]; 2], [[0.0; 3]; 2]);
        for i in 0..2 {
            let raw = p[i] / p[2];
            slope[i] = raw.clamp(self.limit[i][0], self.limit[i][1]);
            clamped[i] = slope[i] != raw;
            let f = self.focal[i] / p[2];
            for c in 0..3 {
                a[i][c] = f * (self.rows[i][c] - slope[i] * self.rows[2][c]);
            }
            for c in 0..3 {
                m[i][c] = dot(a[i], [r[0][c], r[1][c], r[2][c]]) * scale[c];
            }
        }
        let cov = [dot(m[0], m[0]), dot(m[0], m[1]), dot(m[1], m[1])];
        Some(Shape { p, slope, clamped, unit, norm, rotation: r, scale, a, m, cov })
    }

    fn lowpassed(&self, cov: V3) -> V3 {
        [cov[0] + self.options.lowpass, cov[1], cov[2] + self.options.lowpass]
    }

    fn direction(&self, row: &[f32]) -> (V3, f32) {
        let d = [row[0] - self.eye[0], row[1] - self.eye[1], row[2] - self.eye[2]];
        let length = dot(d, d).sqrt();
        (d.map(|v| v / length), length)
    }

    /// Projects splat `i`.
    pub fn project(&self, splats: &Splats, i: usize) -> Projected {
        let row = &splats.rows[11 * i..11 * i + 11];
        let Some(s) = self.shape(row) else { return Projected::default() };
        let cov = self.lowpassed(s.cov);
        let area = det(cov);
        if !(area > 0.0 && area.is_finite()) {
            return Projected::default();
        }
        let mut opacity = row[10];
        if self.options.antialiased {
            opacity *= (det(s.cov) / area).max(0.0).sqrt();
        }
        let mid = 0.5 * (cov[0] + cov[2]);
        let largest = mid + (mid * mid - area).max(0.0).sqrt();
        let uv = [
            self.focal[0] * s.p[0] / s.p[2] + self.centre[0],
            self.focal[1] * s.p[1] / s.p[2] + self.centre[1],
        ];
        let (direction, _) = self.direction(row);
        let basis = sh::basis(splats.sh_degree, direction);
        let set = &splats.sh[splats.sh_at(i)..];
        let mut sum = [0.0; 3];
        for k in 0..(splats.sh_degree + 1) * (splats.sh_degree + 1) {
            for c in 0..3 {
                sum[c] += basis[k] * set[3 * k + c];
            }
        }
        let gain = splats.gain(i);
        Projected {
            uv,
            conic: [cov[2] / area, -cov[1] / area, cov[0] / area],
            opacity,
            rgb: sum.map(|v| (0.5 + gain * v).max(0.0)),
            z: s.p[2],
            radius: (self.options.box_sigmas * largest.sqrt()).ceil(),
        }
    }

    /// Adds the gradients of splat `i` to `out`.
    pub fn backward(&self, splats: &Splats, i: usize, g: &ProjectedGrad, out: &mut Gradients) {
        let row = &splats.rows[11 * i..11 * i + 11];
        let Some(s) = self.shape(row) else { return };
        let mut v_mean = self.colour_backward(splats, i, g.rgb, out);
        let (v_cov, v_opacity) = self.covariance_backward(&s, row[10], g);
        let v_row = &mut out.rows[11 * i..11 * i + 11];
        v_row[10] += v_opacity;
        // M·Mᵀ: the gradient of M is 2·G·M, G the full symmetric matrix.
        let (mut v_m, mut v_a) = ([[0.0; 3]; 2], [[0.0; 3]; 2]);
        for c in 0..3 {
            v_m[0][c] = 2.0 * (v_cov[0] * s.m[0][c] + v_cov[1] * s.m[1][c]);
            v_m[1][c] = 2.0 * (v_cov[1] * s.m[0][c] + v_cov[2] * s.m[1][c]);
        }
        let mut v_rotation = [[0.0; 3]; 3];
        for c in 0..3 {
            for k in 0..3 {
                let v = s.a[0][k] * v_m[0][c] + s.a[1][k] * v_m[1][c];
                v_row[7 + c] += v * s.rotation[k][c];
                v_rotation[k][c] = v * s.scale[c];
                v_a[0][k] += v_m[0][c] * s.rotation[k][c] * s.scale[c];
                v_a[1][k] += v_m[1][c] * s.rotation[k][c] * s.scale[c];
            }
        }
        let v_unit = rotation_backward(s.unit, &v_rotation);
        let along: f32 = (0..4).map(|c| v_unit[c] * s.unit[c]).sum();
        for c in 0..4 {
            v_row[3 + c] += (v_unit[c] - along * s.unit[c]) / s.norm;
        }
        let v_p = self.position_backward(&s, &v_a, g.uv);
        for c in 0..3 {
            v_mean[c] += (0..3).map(|k| self.rows[k][c] * v_p[k]).sum::<f32>();
            v_row[c] += v_mean[c];
        }
    }

    /// Returns the gradients of the covariance without the low-pass (xx, half of xy, yy: the full
    /// symmetric matrix) and of the opacity.
    fn covariance_backward(&self, s: &Shape, opacity: f32, g: &ProjectedGrad) -> (V3, f32) {
        let cov = self.lowpassed(s.cov);
        let area = det(cov);
        let [a, b, c] = [cov[2] / area, -cov[1] / area, cov[0] / area];
        let [va, vb, vc] = [g.conic[0], 0.5 * g.conic[1], g.conic[2]];
        // −Q·G·Q with Q the conic.
        let (r00, r01) = (va * a + vb * b, va * b + vb * c);
        let (r10, r11) = (vb * a + vc * b, vb * b + vc * c);
        let mut v = [-(a * r00 + b * r10), -(a * r01 + b * r11), -(b * r01 + c * r11)];
        let mut v_opacity = g.opacity;
        if self.options.antialiased {
            let bare = det(s.cov);
            let ratio = (bare / area).max(0.0).sqrt();
            v_opacity *= ratio;
            if ratio > 0.0 {
                let half = 0.5 * g.opacity * opacity * ratio;
                v[0] += half * (s.cov[2] / bare - a);
                v[1] += half * (-s.cov[1] / bare - b);
                v[2] += half * (s.cov[0] / bare - c);
            }
        }
        (v, v_opacity)
    }

    /// Returns the gradient of the mean in camera coordinates, from J·W and the pixel position.
    fn position_backward(&self, s: &Shape, v_a: &[V3; 2], v_uv: [f32; 2]) -> V3 {
        let mut v_p = [0.0; 3];
        for i in 0..2 {
            let f = self.focal[i] / s.p[2];
            // Row i of J is f·(1 at i, −slope at z).
            let (v_one, v_z) = (dot(v_a[i], self.rows[i]), dot(v_a[i], self.rows[2]));
            v_p[2] += (s.slope[i] * v_z - v_one) * f / s.p[2];
            if !s.clamped[i] {
                v_p[i] -= f * v_z / s.p[2];
                v_p[2] += f * v_z * s.p[i] / (s.p[2] * s.p[2]);
            }
            v_p[i] += f * v_uv[i];
            v_p[2] -= f * v_uv[i] * s.p[i] / s.p[2];
        }
        v_p
    }

    /// Adds the gradients of SH and gain; returns the gradient of the mean through the direction.
    fn colour_backward(&self, splats: &Splats, i: usize, v_rgb: V3, out: &mut Gradients) -> V3 {
        let row = &splats.rows[11 * i..11 * i + 11];
        let (direction, length) = self.direction(row);
        if !(length > 0.0) {
            return [0.0; 3];
        }
        let count = (splats.sh_degree + 1) * (splats.sh_degree + 1);
        let basis = sh::basis(splats.sh_degree, direction);
        let slopes = sh::derivatives(splats.sh_degree, direction);
        let at = splats.sh_at(i);
        let set = &splats.sh[at..at + 3 * count];
        let mut sum = [0.0; 3];
        for k in 0..count {
            for c in 0..3 {
                sum[c] += basis[k] * set[3 * k + c];
            }
        }
        let gain = splats.gain(i);
        let mut v_sum = [0.0; 3];
        for c in 0..3 {
            if 0.5 + gain * sum[c] > 0.0 {
                v_sum[c] = gain * v_rgb[c];
                if let Some(v) = out.gain.get_mut(i) {
                    *v += v_rgb[c] * sum[c];
                }
            }
        }
        let v_set = &mut out.sh[at..at + 3 * count];
        let mut v_direction = [0.0; 3];
        for k in 0..count {
            let mut pull = 0.0;
            for c in 0..3 {
                v_set[3 * k + c] += basis[k] * v_sum[c];
                pull += set[3 * k + c] * v_sum[c];
            }
            for c in 0..3 {
                v_direction[c] += slopes[k][c] * pull;
            }
        }
        let along = dot(v_direction, direction);
        [0, 1, 2].map(|c| (v_direction[c] - along * direction[c]) / length)
    }
}
