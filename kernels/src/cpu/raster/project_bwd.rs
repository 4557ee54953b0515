//! Backward of [`crate::cpu::raster::project`]: from the pixels' sums to gradients of the inputs,
//! sixteen splats at a time, in parallel over families of children.
//!
//! One thread adds a parent's SH gradient over its children in their order, so that the
//! number of threads does not change a byte. A harmless splat with sums of zero replaces
//! every splat without pixels, so that its gradients are 0 whatever numbers it holds.

pub use crate::layout::Gradients;

use crate::cpu::raster::blend_bwd::{PairSums, SUMS};
use crate::cpu::raster::colour_bwd::Directions;
use crate::cpu::raster::ewa::{Footprint, View};
use crate::cpu::raster::ewa_bwd::{Moments, Whitening, cov6_gradient, quat_gradient};
use crate::cpu::raster::project::{Geometry, SplatSlices, floats_at};
use crate::cpu::simd::{Kernel, Simd, SimdLevel};
use crate::layout::{
    MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, RasterOptions, SCALE_OFFSET, SPLAT_STRIDE,
    ShDirection,
};
use rayon::prelude::*;

/// Splats side by side.
pub(crate) const GROUP: usize = 16;
/// Splats per unit of parallel work, about.
const PART: usize = 2048;

pub(crate) type L = [f32; GROUP];

/// Inputs of the pass over all splats.
#[derive(Clone, Copy)]
pub(crate) struct Pass<'a> {
    pub(crate) splats: &'a SplatSlices<'a>,
    pub(crate) view: &'a View,
    pub(crate) options: &'a RasterOptions,
    /// `[N]`.
    pub(crate) footprints: &'a [Footprint],
    /// `[N]`; read where the footprint is visible.
    pub(crate) sums: &'a [PairSums],
    /// `[P]`: Σ sh·Y of each parent ([`ShDirection::Parent`] only).
    pub(crate) radiance: &'a [[f32; 3]],
}

/// The gradients of a run of whole families.
pub(crate) struct Part<'a> {
    /// First splat.
    pub(crate) first: usize,
    pub(crate) len: usize,
    rows: &'a mut [f32],
    means: &'a mut [f32],
    cov6: &'a mut [f32],
    quats: &'a mut [f32],
    scales: &'a mut [f32],
    opacities: &'a mut [f32],
    pub(crate) sh: &'a mut [f32],
    /// Numbers of a parent in `sh`.
    pub(crate) set: usize,
    gain: &'a mut [f32],
    /// Numbers of [`SplatSlices::gain`] per splat.
    gain_channels: usize,
}

/// Sixteen splats in structure of arrays.
#[derive(Default)]
#[repr(C, align(64))]
pub(crate) struct Group {
    pub(crate) mean: [L; 3],
    quat: [L; 4],
    scale: [L; 3],
    cov6: [L; 6],
    opacity: L,
    whitening: [L; 3],
    pub(crate) sums: [L; SUMS],
    pub(crate) d_mean: [L; 3],
    d_quat: [L; 4],
    d_scale: [L; 3],
    d_cov6: [L; 6],
    d_opacity: L,
}

/// One part of a pass, compiled for a level.
struct PartOf<'a, 'b>(&'a Pass<'b>, Part<'a>);

impl Kernel for PartOf<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        self.0.part(s, self.1);
    }
}

impl Pass<'_> {
    /// Fills `out`, the background's gradient apart.
    pub(crate) fn run(&self, level: SimdLevel, out: &mut Gradients) {
        let n = self.splats.len();
        out.fit(self.splats);
        let children = self.splats.children_per_parent();
        let families = (PART / children).max(1);
        let len = families * children;
        let set = 3 * out.coefficients(self.splats.sh_degree);
        let gain_channels = self.splats.gain.len().checked_div(n).unwrap_or(0);
        let mut rows = out.rows.chunks_mut(len * SPLAT_STRIDE);
        let mut means = out.means.chunks_mut(3 * len);
        let mut cov6 = out.cov6.chunks_mut(6 * len);
        let mut quats = out.quats.chunks_mut(4 * len);
        let mut scales = out.scales.chunks_mut(3 * len);
        let mut opacities = out.opacities.chunks_mut(len);
        let mut sh = out.sh.chunks_mut((families * set).max(1));
        let mut gain = out.gain.chunks_mut((len * gain_channels).max(1));
        let parts: Vec<Part> = (0..n)
            .step_by(len)
            .map(|first| Part {
                first,
                len: len.min(n - first),
                rows: rows.next().unwrap_or_default(),
                means: means.next().unwrap_or_default(),
                cov6: cov6.next().unwrap_or_default(),
                quats: quats.next().unwrap_or_default(),
                scales: scales.next().unwrap_or_default(),
                opacities: opacities.next().unwrap_or_default(),
                sh: sh.next().unwrap_or_default(),
                set,
                gain: gain.next().unwrap_or_default(),
                gain_channels,
            })
            .collect();
        parts.into_par_iter().for_each(|part| level.run(PartOf(self, part)));
    }

    #[inline(always)]
    fn part<S: Simd>(&self, s: S, mut part: Part) {
        let shared = self.options.sh_direction == ShDirection::Parent;
        let plain = self.options.sh_direction == ShDirection::Colour;
        // Without siblings, every SH set is written once; or first written, then added to.
        let single = !shared && (self.splats.children_per_parent() == 1 || self.wide());
        if !single {
            part.sh.fill(0.0);
        }
        let mut group = Group::default();
        let mut seen = Directions::default();
        for at in (0..part.len).step_by(GROUP) {
            let count = GROUP.min(part.len - at);
            let alive = self.load(part.first + at, count, &mut group);
            if alive == 0 {
                let children = self.splats.children_per_parent();
                part.clear(at, count, single.then_some(children));
                continue;
            }
            self.geometry(&mut group);
            if plain {
                self.plain_colours(&mut part, (at, single), alive, &group);
            } else if !shared {
                self.child_colours(s, &mut part, (at, single), alive, &mut group, &mut seen);
            } else {
                self.parent_gains(&mut part, at, count, &group);
            }
            part.store(at, count, &group);
        }
        if shared {
            self.parent_colours(&mut part, &mut seen);
        }
    }

    /// Fills `group` with splats `first..first + count`; returns the mask of those that
    /// some pixel may have seen.
    #[inline(always)]
    fn load(&self, first: usize, count: usize, group: &mut Group) -> u32 {
        let mut alive = 0;
        for l in 0..GROUP {
            let i = first + l;
            let sums = (l < count && self.footprints[i].visible()).then(|| self.sums_of(i));
            match sums.filter(|s| s.iter().any(|&v| v != 0.0)) {
                Some(sums) => {
                    alive |= 1 << l;
                    let f = &self.footprints[i];
                    put(&mut group.whitening, l, [f.sx, f.sx * f.shear, f.sy]);
                    put(&mut group.sums, l, sums);
                    put(&mut group.mean, l, self.splats.mean(i));
                    match self.splats.geometry {
                        Geometry::Packed(rows) => {
                            let row: [f32; SPLAT_STRIDE] = floats_at(rows, i * SPLAT_STRIDE);
                            put::<4>(&mut group.quat, l, floats_at(&row, QUAT_OFFSET));
                            put::<3>(&mut group.scale, l, floats_at(&row, SCALE_OFFSET));
                            group.opacity[l] = row[OPACITY_OFFSET];
                        }
                        Geometry::Cov6 { cov6, opacities, .. } => {
                            put::<6>(&mut group.cov6, l, floats_at(cov6, 6 * i));
                            group.opacity[l] = opacities[i];
                        }
                        Geometry::Separate { quats, scales, opacities, .. } => {
                            put::<4>(&mut group.quat, l, floats_at(quats, 4 * i));
                            put::<3>(&mut group.scale, l, floats_at(scales, 3 * i));
                            group.opacity[l] = opacities[i];
                        }
                    }
                }
                None => {
                    // A unit ball one unit in front of the eye.
                    let ahead = std::array::from_fn(|c| self.view.eye[c] + self.view.rows[2][c]);
                    put(&mut group.mean, l, ahead);
                    put(&mut group.quat, l, [1.0, 0.0, 0.0, 0.0]);
                    put(&mut group.scale, l, [1.0; 3]);
                    put(&mut group.cov6, l, [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]);
                    put(&mut group.whitening, l, [1.0, 0.0, 1.0]);
                    put(&mut group.sums, l, [0.0; SUMS]);
                    group.opacity[l] = 1.0;
                }
            }
        }
        alive
    }

    /// The sums of visible splat `i`, those of a clamped colour channel as 0.
    #[inline(always)]
    pub(crate) fn sums_of(&self, i: usize) -> [f32; SUMS] {
        let mut sums = self.sums[i];
        if self.options.sh_direction == ShDirection::Colour {
            return sums;
        }
        for (v, colour) in sums[6..9].iter_mut().zip(self.footprints[i].rgb) {
            *v = if colour > 0.0 { *v } else { 0.0 };
        }
        sums
    }

    #[inline(always)]
    fn geometry(&self, group: &mut Group) {
        let view = self.view;
        // Two loops: in one, every splat would be taken both ways.
        if matches!(self.splats.geometry, Geometry::Cov6 { .. }) {
            for l in 0..GROUP {
                let (m, w, mean) = group.one(l);
                let g = cov6_gradient(view, mean, get(&group.cov6, l), w, &m);
                put(&mut group.d_mean, l, g.mean);
                put(&mut group.d_cov6, l, g.cov6);
                group.d_opacity[l] = m.one / group.opacity[l];
            }
        } else {
            for l in 0..GROUP {
                let (m, w, mean) = group.one(l);
                let (quat, scale) = (get(&group.quat, l), get(&group.scale, l));
                let g = quat_gradient(view, mean, quat, scale, w, &m);
                put(&mut group.d_mean, l, g.mean);
                put(&mut group.d_quat, l, g.quat);
                put(&mut group.d_scale, l, g.scale);
                group.d_opacity[l] = m.one / group.opacity[l];
            }
        }
    }
}

impl Group {
    #[inline(always)]
    fn one(&self, l: usize) -> (Moments, Whitening, [f32; 3]) {
        let [a, b, c] = get(&self.whitening, l);
        (Moments::from(get(&self.sums, l)), Whitening { a, b, c }, get(&self.mean, l))
    }
}

impl Part<'_> {
    /// Zeros for splats that no pixel saw; with the number of children per parent, for
    /// the SH sets too of which they are the first.
    fn clear(&mut self, at: usize, count: usize, children: Option<usize>) {
        let zero = |values: &mut [f32], lanes: usize| {
            if let Some(v) = values.get_mut(at * lanes..(at + count) * lanes) {
                v.fill(0.0);
            }
        };
        zero(self.rows, SPLAT_STRIDE);
        zero(self.means, 3);
        zero(self.cov6, 6);
        zero(self.quats, 4);
        zero(self.scales, 3);
        zero(self.opacities, 1);
        zero(self.gain, self.gain_channels);
        if let Some(children) = children {
            let sets = at.div_ceil(children) * self.set..(at + count).div_ceil(children) * self.set;
            if let Some(sh) = self.sh.get_mut(sets) {
                sh.fill(0.0);
            }
        }
    }

    #[inline(always)]
    fn store(&mut self, at: usize, count: usize, group: &Group) {
        for l in 0..count {
            let j = at + l;
            if self.rows.is_empty() {
                set(self.means, 3 * j, get::<3>(&group.d_mean, l));
                // Of the following three, those of another geometry are empty.
                set(self.cov6, 6 * j, get::<6>(&group.d_cov6, l));
                set(self.quats, 4 * j, get::<4>(&group.d_quat, l));
                set(self.scales, 3 * j, get::<3>(&group.d_scale, l));
                set(self.opacities, j, [group.d_opacity[l]]);
            } else {
                let row = &mut self.rows[j * SPLAT_STRIDE..(j + 1) * SPLAT_STRIDE];
                set(row, MEAN_OFFSET, get::<3>(&group.d_mean, l));
                set(row, QUAT_OFFSET, get::<4>(&group.d_quat, l));
                set(row, SCALE_OFFSET, get::<3>(&group.d_scale, l));
                set(row, OPACITY_OFFSET, [group.d_opacity[l]]);
            }
        }
    }

    /// γ of splat `j` of the part.
    #[inline(always)]
    pub(crate) fn gain_of(&self, splats: &SplatSlices, j: usize) -> f32 {
        let at = (self.first + j) * self.gain_channels;
        splats.gain.get(at).copied().filter(|_| self.gain_channels > 0).unwrap_or(1.0)
    }

    /// Writes ∂L/∂γ and, with four channels, ∂L/∂δ of splat `j` of the part.
    #[inline(always)]
    pub(crate) fn put_gain(&mut self, j: usize, gain: f32, [r, g, b]: [f32; 3]) {
        match self.gain_channels {
            1 => self.gain[j] = gain,
            4 => set(self.gain, 4 * j, [gain, r, g, b]),
            _ => {}
        }
    }

    pub(crate) fn add_mean(&mut self, j: usize, g: [f32; 3]) {
        let (values, lanes) = if self.rows.is_empty() {
            (&mut *self.means, 3)
        } else {
            (&mut *self.rows, SPLAT_STRIDE)
        };
        for (v, g) in values[j * lanes..j * lanes + 3].iter_mut().zip(g) {
            *v += g;
        }
    }
}

#[inline(always)]
pub(crate) fn get<const N: usize>(from: &[L; N], l: usize) -> [f32; N] {
    std::array::from_fn(|k| from[k][l])
}

#[inline(always)]
pub(crate) fn put<const N: usize>(to: &mut [L; N], l: usize, values: [f32; N]) {
    for (k, v) in values.into_iter().enumerate() {
        to[k][l] = v;
    }
}

#[inline(always)]
fn set<const N: usize>(to: &mut [f32], at: usize, values: [f32; N]) {
    if let Some(to) = to.get_mut(at..at + N) {
        to.copy_from_slice(&values);
    }
}
