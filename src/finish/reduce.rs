//! Reduces the number of Gaussians of a finished scene: those that the cameras hardly show are
//! removed, then neighbours are merged.
//!
//! A merge ([`super::merge`]) keeps the moments of a pair and its integrated optical depth.
//! Pairs are neighbours along two curves through space (Morton order). The cost of a pair is Ward's:
//! `s₁s₂/(s₁ + s₂) · (|Δc|² + κ·Δμᵀ(Σ₁ + Σ₂)⁻¹Δμ)`, s the Gaussians' shares of the pictures and c
//! their mean colour. Rounds of disjoint pairs, the cheapest first, lead to the wanted number.
//!
//! The constants were chosen on `examples/room`. There the removal of half of the Gaussians by their
//! shares alone costs 0.09 dB at new views, and a merge nothing; of three quarters it costs 1.26 dB, and
//! a merge nothing. A fit of the merged Gaussians to the pictures of all changed nothing.
//!
//! Neighbours of one colour carry nothing of their own, while every Gaussian that is removed leaves a gap: hence
//! merges, not removal (table in `tools/lab/tried.md`).
//!
//! The same input gives the same bytes on any number of threads.

use super::merge::{Blob, CURVE_BITS, curve_code, folded};
use super::removal::shares;
use super::targets::MaskedView;
use crate::scene::pictures::Rgb;
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use glam::{DMat3, DVec3, Vec2, Vec3};
use rayon::prelude::*;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{RasterOptions, SPLAT_STRIDE};
use subsplat_kernels::sh::C0;

/// κ: cost of a distance of one standard deviation, squared display values.
const DISTANCE_COST: f64 = 0.001;
/// Share of all pictures that the removed Gaussians have together.
const HIDDEN_SHARE: f64 = 0.002;
/// Share of the Gaussians that a round merges at most.
const ROUND: f64 = 0.2;
/// Neighbours along a curve with which a Gaussian may be merged.
const NEIGHBOURS: usize = 5;

/// Returns at most `count` Gaussians (at least one) that give nearly the pictures of `splats` at
/// `cameras`, each with an SH set of its own. Gaussians outside all pictures count as an average one
/// inside, so that no camera is needed.
pub fn reduce(
    splats: &Splats,
    cameras: &[Camera],
    raster: &RasterOptions,
    count: usize,
    renderer: &mut Renderer,
) -> Splats {
    let indices: Vec<usize> = (0..splats.len()).collect();
    let all = folded(splats, &indices);
    let count = count.max(1);
    if all.len() <= count {
        return all;
    }
    let mut shares = picture_shares(&all, cameras, raster, renderer);
    let mut kept = without_hidden(&all, &mut shares, count);
    while kept.len() > count {
        let most = ((kept.len() as f64 * ROUND) as usize).max(1);
        kept = merge_round(&kept, &mut shares, most.min(kept.len() - count));
    }
    kept
}

/// Share of each Gaussian in the pictures of `cameras`, 1 on average.
fn picture_shares(
    splats: &Splats,
    cameras: &[Camera],
    raster: &RasterOptions,
    renderer: &mut Renderer,
) -> Vec<f32> {
    // Only the sizes of the pictures count.
    let blank = |c: &Camera| Rgb::black(c.intrinsics().width, c.intrinsics().height);
    let pictures: Vec<Rgb> = cameras.iter().map(blank).collect();
    let view = |(camera, image)| MaskedView { camera, image, mask: None };
    let views: Vec<MaskedView<'_>> = cameras.iter().zip(&pictures).map(view).collect();
    let mut found = if views.is_empty() {
        vec![1.0; splats.len()]
    } else {
        shares(splats, &views, raster, renderer)
    };
    found.par_iter_mut().enumerate().for_each(|(i, share)| {
        let mean = Vec3::from_array(splats.mean(i));
        if !cameras.iter().any(|camera| shows(camera, mean)) {
            *share = 1.0;
        }
    });
    found
}

/// Returns whether a point lies before a camera and inside its picture.
fn shows(camera: &Camera, point: Vec3) -> bool {
    let k = camera.intrinsics();
    let inside =
        |px: Vec2| (0.0..k.width as f32).contains(&px.x) && (0.0..k.height as f32).contains(&px.y);
    camera.project(point).is_some_and(inside)
}

/// Removes the Gaussians with the smallest shares, which have [`HIDDEN_SHARE`] together; `count` of them
/// stay.
fn without_hidden(splats: &Splats, shares: &mut Vec<f32>, count: usize) -> Splats {
    let mut order: Vec<usize> = (0..splats.len()).collect();
    order.sort_by(|a, b| shares[*a].total_cmp(&shares[*b]).then(a.cmp(b)));
    let limit = HIDDEN_SHARE * shares.iter().copied().map(f64::from).sum::<f64>();
    let (mut sum, mut removed) = (0.0, 0);
    for &i in order.iter().take(splats.len().saturating_sub(count)) {
        sum += f64::from(shares[i]);
        if sum > limit {
            break;
        }
        removed += 1;
    }
    let mut kept = order.split_off(removed);
    kept.sort_unstable();
    *shares = kept.iter().map(|&i| shares[i]).collect();
    splats.selected(&kept)
}

/// A Gaussian with the numbers that the cost of a merge depends on.
#[derive(Clone, Copy)]
struct Member {
    blob: Blob,
    /// Mean colour over all directions, display values.
    colour: DVec3,
    /// Share in the pictures, 1 on average.
    share: f64,
}

/// A pair of Gaussians and the cost of their merge.
#[derive(Clone, Copy)]
struct Pair {
    cost: f64,
    first: u32,
    second: u32,
}

/// Merges at most `most` disjoint pairs, the cheapest first.
fn merge_round(splats: &Splats, shares: &mut Vec<f32>, most: usize) -> Splats {
    let blobs: Vec<Blob> =
        (0..splats.len()).into_par_iter().map(|i| Blob::of(splats.row(i))).collect();
    let member = |i: usize| Member {
        blob: blobs[i],
        colour: DVec3::from_array([0, 1, 2].map(|c| C0 * f64::from(splats.sh_of(i)[c]))),
        share: f64::from(shares[i]).max(0.0),
    };
    let members: Vec<Member> = (0..splats.len()).into_par_iter().map(member).collect();
    let mut pairs = Vec::new();
    for shift in [0.0, 1.0 / 3.0] {
        let order = along_curve(&blobs, shift);
        let of = |at: usize| {
            let partners = order[at + 1..].iter().take(NEIGHBOURS);
            let (order, members) = (&order, &members);
            partners.map(move |&partner| {
                let a = order[at] as usize;
                let b = partner as usize;
                let cost = cost(&members[a], &members[b]);
                Pair { cost, first: a.min(b) as u32, second: a.max(b) as u32 }
            })
        };
        pairs.par_extend((0..order.len()).into_par_iter().flat_map_iter(of));
    }
    pairs.par_sort_unstable_by(|a, b| {
        a.cost.total_cmp(&b.cost).then((a.first, a.second).cmp(&(b.first, b.second)))
    });
    let mut partner: Vec<Option<u32>> = vec![None; splats.len()];
    let mut merged = 0;
    for pair in &pairs {
        let (a, b) = (pair.first as usize, pair.second as usize);
        if merged == most {
            break;
        }
        if partner[a].is_none() && partner[b].is_none() {
            (partner[a], partner[b]) = (Some(pair.second), Some(pair.first));
            merged += 1;
        }
    }
    let stays = |i: &usize| partner[*i].is_none_or(|p| p as usize > *i);
    let kept: Vec<usize> = (0..splats.len()).filter(stays).collect();
    let mut result = splats.selected(&kept);
    let set = 3 * result.sh_coefficients();
    for (at, &i) in kept.iter().enumerate() {
        let Some(j) = partner[i].map(|p| p as usize) else { continue };
        let row = &mut result.rows[at * SPLAT_STRIDE..(at + 1) * SPLAT_STRIDE];
        let pair = [&blobs[i], &blobs[j]].map(|blob| blob.moments(0.0));
        let part = pair[0].share_of(&pair[1]);
        pair[0].joined(&pair[1]).write(0.0, row);
        let sh = result.sh[at * set..(at + 1) * set].iter_mut();
        sh.zip(splats.sh_of(j)).for_each(|(v, other)| *v += part as f32 * (other - *v));
    }
    *shares =
        kept.iter().map(|&i| shares[i] + partner[i].map_or(0.0, |j| shares[j as usize])).collect();
    result
}

/// Order of the Gaussians along a Morton curve through their means, moved by a share of their extent.
fn along_curve(blobs: &[Blob], shift: f64) -> Vec<u32> {
    let low = blobs.iter().fold(DVec3::INFINITY, |m, b| m.min(b.mean));
    let high = blobs.iter().fold(DVec3::NEG_INFINITY, |m, b| m.max(b.mean));
    // The shifted curve covers the extent too.
    let cells = f64::from((1u32 << CURVE_BITS) - 1) / (1.0 + shift);
    let extent = (high - low).max(DVec3::splat(f64::MIN_POSITIVE));
    let code = |i: usize| {
        let at = ((blobs[i].mean - low) / extent + shift) * cells;
        (curve_code(at), i as u32)
    };
    let mut codes: Vec<(u64, u32)> = (0..blobs.len()).into_par_iter().map(code).collect();
    codes.par_sort_unstable();
    codes.into_iter().map(|(_, i)| i).collect()
}

/// Ward's cost of a merge.
fn cost(a: &Member, b: &Member) -> f64 {
    let half = a.share * b.share / (a.share + b.share).max(f64::MIN_POSITIVE);
    let between = b.blob.mean - a.blob.mean;
    let joint = a.blob.covariance + b.blob.covariance;
    // Flat Gaussians have no inverse.
    let floor = 1e-6 * (joint.x_axis.x + joint.y_axis.y + joint.z_axis.z) + f64::MIN_POSITIVE;
    let inverse = (joint + DMat3::from_diagonal(DVec3::splat(floor))).inverse();
    let distance = between.dot(inverse * between);
    let distance = if distance.is_finite() { distance.max(0.0) } else { f64::INFINITY };
    // The first term keeps the order where all shares are 0.
    (half + 1e-9) * ((b.colour - a.colour).length_squared() + DISTANCE_COST * distance)
}
