//! Scenes for timing rasterizers, from a fixed formula and seed: the pixel grids of two views on
//! a depth map with steps, like the output of a pixel-aligned network.
//!
//! Grid pixel (i, j) of a view gives one splat at the intersection of its ray with a synthetic
//! room (a slanted back wall with waves, a floor, boards in front of them). σ is a fixed number
//! of pixels of the rendered picture, times a random factor. Opacities are distributed as in a
//! trained model (40 % near 0, 50 % above ½). SH degree 0 is a texture of squares; higher degrees
//! are small. Splats of the shared form are groups of 2×2: four children of a parent that has the
//! SH set, each child with a gain.

use glam::{Mat4, Quat, Vec3};
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::ShBasis;
use subsplat_kernels::layout::random::{GOLDEN, mix};

/// SH degree of all scenes.
pub const DEGREE: usize = 3;
/// Focal length relative to the picture's side: a field of view of 58°.
const FOCAL: f32 = 0.9;

/// One scene at one picture size.
#[derive(Clone, Copy, Debug)]
pub struct Spec {
    /// Name in tables and files: N, then the picture's side.
    pub name: &'static str,
    /// Side of each view's grid: N = 2·grid².
    pub grid: usize,
    /// Side of the picture that the σ are given at, px.
    pub sigma_at: usize,
    /// Mean σ there, px.
    pub sigma_px: f32,
    /// Side of the rendered picture, px.
    pub side: usize,
}

/// The scenes of the benches; the first is small enough for the naive oracle.
pub const SCENES: [Spec; 7] = [
    Spec { name: "8k-128", grid: 64, sigma_at: 128, sigma_px: 1.5, side: 128 },
    Spec { name: "131k-256", grid: 256, sigma_at: 512, sigma_px: 1.5, side: 256 },
    Spec { name: "131k-512", grid: 256, sigma_at: 512, sigma_px: 1.5, side: 512 },
    Spec { name: "131k-1024", grid: 256, sigma_at: 512, sigma_px: 1.5, side: 1024 },
    Spec { name: "524k-512", grid: 512, sigma_at: 512, sigma_px: 0.9, side: 512 },
    Spec { name: "524k-1024", grid: 512, sigma_at: 512, sigma_px: 0.9, side: 1024 },
    Spec { name: "2m-1024", grid: 1024, sigma_at: 1024, sigma_px: 0.9, side: 1024 },
];

/// Returns a number in [0, 1) that depends on (stream, index) only.
pub fn unit(stream: u64, index: u64) -> f32 {
    let bits = mix((stream << 40 ^ index).wrapping_add(1).wrapping_mul(GOLDEN));
    (bits >> 40) as f32 / (1u64 << 24) as f32
}

/// Returns an approximately normal number: mean 0, variance 1 (a sum of four uniform numbers).
pub fn normal(stream: u64, index: u64) -> f32 {
    let sum: f32 = (0..4).map(|k| unit(stream, 4 * index + k)).sum();
    (sum - 2.0) * 3f32.sqrt()
}

/// Returns the rendering camera, between the two views.
pub fn camera(side: usize) -> Camera {
    posed(Vec3::new(0.04, -0.02, 0.03), 0.01, side)
}

fn posed(at: Vec3, angle: f32, side: usize) -> Camera {
    let f = FOCAL * side as f32;
    let c = 0.5 * side as f32;
    let intrinsics = Intrinsics { fx: f, fy: f, cx: c, cy: c, width: side, height: side };
    let pose = Mat4::from_rotation_translation(Quat::from_rotation_y(angle), at);
    Camera::new(intrinsics, pose).expect("a valid camera")
}

/// Returns the two views whose pixels are the splats.
pub fn views(grid: usize) -> [Camera; 2] {
    [posed(Vec3::new(-0.3, 0.0, 0.0), 0.06, grid), posed(Vec3::new(0.3, 0.03, 0.05), -0.06, grid)]
}

/// Returns the distance along `ray` at which a ray from `eye` intersects the room.
fn room_distance(eye: Vec3, ray: Vec3) -> f32 {
    let plane = |n: Vec3, d: f32| (d - n.dot(eye)) / n.dot(ray);
    let wall = plane(Vec3::new(0.15, -0.05, 1.0), 7.0);
    let at = eye + wall * ray;
    let mut nearest = wall * (1.0 + 0.02 * (2.3 * at.x).sin() * (1.9 * at.y).cos());
    let floor = plane(Vec3::new(0.02, 1.0, 0.0), 1.6);
    if floor > 0.0 {
        nearest = nearest.min(floor);
    }
    for board in 0..12 {
        let r = |k: u64| unit(1, 8 * board + k);
        let z = 2.2 + 3.6 * r(0);
        let (x, y) = ((r(1) - 0.5) * 1.1 * z, (r(2) - 0.5) * 0.9 * z);
        let (half_x, half_y) = (0.1 + 0.35 * r(3), 0.1 + 0.45 * r(4));
        let t = (z - eye.z) / ray.z;
        let p = eye + t * ray;
        if (p.x - x).abs() < half_x && (p.y - y).abs() < half_y {
            nearest = nearest.min(t);
        }
    }
    nearest
}

/// Returns the splats of `spec` in the shared form: P = N / 4 SH sets, one gain per child.
pub fn shared(spec: &Spec) -> Splats {
    let half = spec.grid / 2;
    let n = 2 * spec.grid * spec.grid;
    let (mut rows, mut sh) = (Vec::with_capacity(11 * n), Vec::with_capacity(12 * n));
    let mut gain = Vec::with_capacity(n);
    let px = spec.sigma_px / (FOCAL * spec.sigma_at as f32);
    for (v, view) in views(spec.grid).iter().enumerate() {
        for parent in 0..half * half {
            let corner = [2 * (parent % half), 2 * (parent / half)];
            let mut first = None;
            for child in 0..4 {
                let index = (v * n / 2 + 4 * parent + child) as u64;
                let at = [corner[0] + child % 2, corner[1] + child / 2];
                let mean = row(view, at, px, index, &mut rows);
                first.get_or_insert(mean);
                gain.push(0.9 + 0.2 * unit(7, index));
            }
            let index = (v * half * half + parent) as u64;
            harmonics(first.unwrap_or_default(), index, &mut sh);
        }
    }
    Splats::new(rows, sh, gain, DEGREE, ShBasis::Standard).expect("buffers of one length")
}

/// Appends the splat of grid pixel `at`, with σ of about `px` times its depth; returns its mean.
fn row(view: &Camera, at: [usize; 2], px: f32, index: u64, rows: &mut Vec<f32>) -> Vec3 {
    let pixel = glam::Vec2::new(at[0] as f32 + 0.5, at[1] as f32 + 0.5);
    let ray = view.rotation() * view.intrinsics().unproject(pixel);
    // Depths of a network are slightly rough.
    let depth = room_distance(view.position(), ray) * (1.0 + 0.004 * normal(2, index));
    let mean = view.position() + depth * ray;
    rows.extend(mean.to_array());
    let quat = [0, 1, 2, 3].map(|k| normal(3, 4 * index + k));
    let length = quat.iter().map(|q| q * q).sum::<f32>().sqrt().max(1e-3);
    rows.extend(quat.map(|q| q / length));
    rows.extend([0, 1, 2].map(|k| px * depth * (0.3 * normal(4, 3 * index + k)).exp()));
    let (which, u) = (unit(5, index), unit(6, index));
    rows.push(match which {
        w if w < 0.4 => 0.12 * u * u,
        w if w < 0.9 => 0.5 + 0.49 * u,
        _ => 0.1 + 0.4 * u,
    });
    mean
}

/// Appends one SH set: squares of 0.4 world units in degree 0, noise above.
fn harmonics(at: Vec3, index: u64, sh: &mut Vec<f32>) {
    let cell = (at / 0.4).floor();
    let square = (cell.x + 7.0 * cell.y + 13.0 * cell.z).rem_euclid(64.0) as u64;
    for c in 0..3 {
        let colour = 0.15 + 0.7 * unit(8, 3 * square + c) + 0.08 * normal(9, 3 * index + c);
        sh.push((colour - 0.5) / 0.282_094_8);
    }
    let rest = 3 * ((DEGREE + 1) * (DEGREE + 1) - 1) as u64;
    sh.extend((0..rest).map(|k| 0.05 * normal(10, rest * index + k)));
}

/// Returns the same splats with one SH set each: γ_i times the set of the parent, so that both
/// forms give the same picture.
pub fn unshared(shared: &Splats) -> Splats {
    let mut sh = Vec::with_capacity(shared.len() * 3 * shared.sh_coefficients());
    for i in 0..shared.len() {
        let (gain, _) = shared.gain_of(i);
        sh.extend(shared.sh_of(i).iter().map(|v| gain * v));
    }
    Splats::new(shared.rows().to_vec(), sh, Vec::new(), shared.sh_degree(), shared.sh_basis())
        .expect("one set of coefficients a splat")
}
