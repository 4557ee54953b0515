//! Gradient with respect to the pose of a camera, from the gradients of the Gaussians.
//!
//! The rasterizer has no gradient of the camera, but moving a camera is moving the scene the other way.
//! A twist (ω, τ) in camera coordinates changes the pose T (world to camera) to exp(ω, τ)·T:
//!
//! * ∂L/∂τ = R·Σ g: g is the gradient of a mean, with its part through the direction of SH;
//! * ∂L/∂ω = Σ p × R·(g − s) + R·Σ t: p is the mean in camera coordinates, s the part of g through the
//!   direction, which a rotation about the eye does not change, and t the torque on the Gaussian's
//!   rotation, t_j = ½ ∂L/∂q · (e_j ⊗ q).
//!
//! The result `[4, 4]` has the last row 0. Its product with the change of T by any twist is the change of
//! the loss. Along changes that are no twist (shear, scale) it is 0, where gsplat gives what its
//! formulas give: a pose made from a rotation and a translation gets the same gradient.
//!
//! The part through the direction comes from central differences of the basis in f64 (step 1e-5 of the
//! unit direction; polynomials of degree 4: error about 1e-10).

use rayon::prelude::*;
use subsplat::glam::{DMat3, DQuat, DVec3};
use subsplat::kernels::cpu::{Geometry, Gradients, SplatSlices};
use subsplat::kernels::layout::{ShDirection, sh_coefficients};
use subsplat::kernels::sh::{C0, standard};
use subsplat::{Camera, RasterOptions};

/// Gaussians that one thread adds up in turn: the sums do not depend on the number of threads.
const PART: usize = 4096;
/// Step of the central difference, on the unit sphere.
const STEP: f64 = 1e-5;

/// Sums over Gaussians, world coordinates but for `rotation`.
#[derive(Clone, Copy, Default)]
struct Sums {
    /// Σ g.
    translation: DVec3,
    /// Σ p × R·(g − s), camera coordinates.
    rotation: DVec3,
    /// Σ t.
    torque: DVec3,
}

/// Returns ∂L/∂viewmat `[4, 4]`, row-major, of splats in separate arrays; zeros for others.
pub(crate) fn viewmat_gradient(
    splats: &SplatSlices<'_>,
    camera: &Camera,
    options: &RasterOptions,
    gradients: &Gradients,
) -> [f32; 16] {
    let Geometry::Separate { means, quats, .. } = splats.geometry else { return [0.0; 16] };
    let r = camera.rotation().as_dmat3().transpose();
    let eye = camera.position().as_dvec3();
    let degree = match options.sh_direction {
        ShDirection::Colour => 0,
        _ => options.sh_degree.min(splats.sh_degree),
    };
    let set = 3 * sh_coefficients(splats.sh_degree);
    let one = |i: usize| {
        let g = vector(&gradients.means, i);
        let q = quat(quats, i);
        let away = vector(means, i) - eye;
        let mut sums = Sums {
            translation: g,
            torque: torque(q, quat(&gradients.quats, i)),
            ..Sums::default()
        };
        let mut geometric = g;
        if degree > 0 && g != DVec3::ZERO {
            let (sh, by) =
                (&splats.sh[i * set..(i + 1) * set], &gradients.sh[i * set..(i + 1) * set]);
            let colour = [by[0], by[1], by[2]].map(|v| f64::from(v) / C0);
            geometric -= direction_gradient(away, sh, colour, degree);
        }
        sums.rotation = (r * away).cross(r * geometric);
        sums
    };
    let add = |a: Sums, b: Sums| Sums {
        translation: a.translation + b.translation,
        rotation: a.rotation + b.rotation,
        torque: a.torque + b.torque,
    };
    let indices: Vec<usize> = (0..splats.len()).step_by(PART).collect();
    let parts: Vec<Sums> = indices
        .into_par_iter()
        .map(|first| {
            let past = (first + PART).min(splats.len());
            (first..past).map(one).fold(Sums::default(), add)
        })
        .collect();
    let sums = parts.into_iter().fold(Sums::default(), add);
    matrix_gradient(r, -(r * eye), r * sums.translation, sums.rotation + r * sums.torque)
}

/// The matrix whose product with the change of (R, t) by a twist is ω·`by_rotation` + τ·`by_translation`.
fn matrix_gradient(r: DMat3, t: DVec3, by_translation: DVec3, by_rotation: DVec3) -> [f32; 16] {
    // The twist changes t by ω × t + τ and R by [ω]·R.
    let c = by_rotation - t.cross(by_translation);
    let cross = DMat3::from_cols(
        DVec3::new(0.0, c.z, -c.y),
        DVec3::new(-c.z, 0.0, c.x),
        DVec3::new(c.y, -c.x, 0.0),
    );
    let by_r = cross * r * 0.5;
    let mut out = [0.0; 16];
    for (i, row) in out.as_chunks_mut::<4>().0.iter_mut().take(3).enumerate() {
        let values = by_r.row(i).extend(by_translation[i]);
        *row = values.as_vec4().to_array();
    }
    out
}

/// t_j = ½ ∂L/∂q · (e_j ⊗ q).
fn torque(q: DQuat, by: DQuat) -> DVec3 {
    let along = |axis: DVec3| {
        let turned = DQuat::from_xyzw(axis.x, axis.y, axis.z, 0.0) * q;
        0.5 * (turned.x * by.x + turned.y * by.y + turned.z * by.z + turned.w * by.w)
    };
    DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z))
}

/// Gradient of Σ colour·Σ sh·Y with respect to the vector from the eye, world.
fn direction_gradient(away: DVec3, sh: &[f32], colour: [f64; 3], degree: usize) -> DVec3 {
    let length = away.length();
    if !(length > 0.0) || colour == [0.0; 3] {
        return DVec3::ZERO;
    }
    let weight = |k: usize| (0..3).map(|c| colour[c] * f64::from(sh[3 * k + c])).sum::<f64>();
    let mut weights = [0.0; 25];
    for (k, w) in weights.iter_mut().enumerate().take(sh_coefficients(degree)) {
        *w = weight(k);
    }
    let value =
        |d: DVec3| -> f64 { standard(d.normalize()).iter().zip(weights).map(|(y, w)| y * w).sum() };
    let d = away / length;
    let along =
        |axis: DVec3| (value(d + STEP * axis) - value(d - STEP * axis)) / (2.0 * STEP * length);
    DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z))
}

fn vector(from: &[f32], i: usize) -> DVec3 {
    DVec3::new(f64::from(from[3 * i]), f64::from(from[3 * i + 1]), f64::from(from[3 * i + 2]))
}

/// Quaternion `i` of wxyz, of any length.
fn quat(from: &[f32], i: usize) -> DQuat {
    let [w, x, y, z] = [0, 1, 2, 3].map(|c| f64::from(from[4 * i + c]));
    DQuat::from_xyzw(x, y, z, w)
}
