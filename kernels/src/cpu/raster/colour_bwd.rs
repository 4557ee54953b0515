//! Backward of view-dependent colour: SH coefficients, gain and direction, sixteen
//! directions at a time; a part of [`crate::cpu::raster::project_bwd`].

use crate::cpu::raster::project::SplatSlices;
use crate::cpu::raster::project_bwd::{GROUP, Group, L, Part, Pass, get, put};
use crate::cpu::raster::sh_bwd::{used_coefficients, values_and_slope};
use crate::cpu::simd::{Simd, Vector};
use crate::layout::{SH_COEFFICIENTS_MAX, ShBasis, sh_coefficients};

/// Coefficients per channel of degree 3, which has a path for sixteen splats at a time.
const WIDE: usize = 16;

/// Directions of SH evaluation, sixteen at a time.
#[repr(C, align(64))]
pub(crate) struct Directions {
    /// From the eye, world.
    towards: [L; 3],
    /// Σ_c ∂L/∂rgb_c·sh_{k,c}.
    s: [L; SH_COEFFICIENTS_MAX],
    /// Y_k.
    y: [L; SH_COEFFICIENTS_MAX],
    /// Σ_k s_k Y_k.
    value: L,
    /// ∂/∂towards of that.
    slope: [L; 3],
}

impl Default for Directions {
    fn default() -> Self {
        let (s, y) = ([[0.0; GROUP]; SH_COEFFICIENTS_MAX], [[0.0; GROUP]; SH_COEFFICIENTS_MAX]);
        let towards = [[1.0; GROUP]; 3];
        Self { towards, s, y, value: [0.0; GROUP], slope: [[0.0; GROUP]; 3] }
    }
}

impl Directions {
    /// Computes s_k of lane `l` from the colour gradient `g` and one SH set.
    #[inline(always)]
    fn weigh(&mut self, l: usize, used: usize, sh: &[f32], g: [f32; 3]) {
        for (s, h) in self.s[..used].iter_mut().zip(sh.chunks_exact(3)) {
            s[l] = g[0] * h[0] + g[1] * h[1] + g[2] * h[2];
        }
    }

    /// Adds Y ⊗ `g` of lane `l` to one SH set.
    #[inline(always)]
    fn add_to(&self, sh: &mut [f32], l: usize, used: usize, g: [f32; 3]) {
        for (h, y) in sh.chunks_exact_mut(3).zip(&self.y[..used]) {
            h[0] += y[l] * g[0];
            h[1] += y[l] * g[1];
            h[2] += y[l] * g[2];
        }
    }

    /// Writes Y ⊗ `g` of lane `l` over one SH set, or its first coefficients.
    #[inline(always)]
    fn write_to(&self, sh: &mut [f32], l: usize, used: usize, g: [f32; 3]) {
        let (sh, unused) = sh.split_at_mut(sh.len().min(3 * used));
        for (h, y) in sh.chunks_exact_mut(3).zip(&self.y[..used]) {
            h.copy_from_slice(&[y[l] * g[0], y[l] * g[1], y[l] * g[2]]);
        }
        unused.fill(0.0);
    }

    /// Computes [`WIDE`] s_k of all lanes from the colour gradients `g` and the SH sets that
    /// begin at `sets` of `sh`.
    #[inline(always)]
    fn weigh_all<S: Simd>(&mut self, s: S, sh: &[f32], sets: &[usize; GROUP], g: [&L; 3]) {
        let [r, g, b] = g.map(|g| s.load(g));
        for q in 0..WIDE / 4 {
            let [r0, g0, b0, r1] = s.gather4(sh, sets, 12 * q);
            let [g1, b1, r2, g2] = s.gather4(sh, sets, 12 * q + 4);
            let [b2, r3, g3, b3] = s.gather4(sh, sets, 12 * q + 8);
            let sets = [[r0, g0, b0], [r1, g1, b1], [r2, g2, b2], [r3, g3, b3]];
            for (to, h) in self.s[4 * q..].iter_mut().zip(sets) {
                s.store(h[0].fma(r, h[1].fma(g, h[2] * b)), to);
            }
        }
    }

    /// Computes Y ⊗ `g` of every lane, [`WIDE`] coefficients.
    #[inline(always)]
    fn spread<S: Simd>(&self, s: S, g: &[L; 3]) -> [[L; 3]; GROUP] {
        let mut out = [[[0.0; GROUP]; 3]; GROUP];
        let g = [s.load(&g[0]), s.load(&g[1]), s.load(&g[2])];
        for v in 0..3 {
            let mut columns = [s.splat(0.0); GROUP];
            for (j, column) in columns.iter_mut().enumerate() {
                let i = GROUP * v + j;
                *column = s.load(&self.y[i / 3]) * g[i % 3];
            }
            for (out, row) in out.iter_mut().zip(s.transpose(columns)) {
                s.store(row, &mut out[v]);
            }
        }
        out
    }

    #[inline(always)]
    fn evaluate(&mut self, used: usize, basis: ShBasis) {
        match used {
            1 => self.evaluate_first::<1>(basis),
            4 => self.evaluate_first::<4>(basis),
            9 => self.evaluate_first::<9>(basis),
            16 => self.evaluate_first::<16>(basis),
            _ => self.evaluate_first::<SH_COEFFICIENTS_MAX>(basis),
        }
    }

    #[inline(always)]
    fn evaluate_first<const D: usize>(&mut self, basis: ShBasis) {
        for l in 0..GROUP {
            let v: [f32; 3] = get(&self.towards, l);
            let inverse = 1.0 / (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
            let d = [v[0] * inverse, v[1] * inverse, v[2] * inverse];
            let s: [f32; D] = std::array::from_fn(|k| self.s[k][l]);
            let (y, g) = values_and_slope::<D>(basis, d, &s);
            let mut value = 0.0;
            for k in 0..D {
                self.y[k][l] = y[k];
                value += s[k] * y[k];
            }
            self.value[l] = value;
            let radial = d[0] * g[0] + d[1] * g[1] + d[2] * g[2];
            for c in 0..3 {
                self.slope[c][l] = (g[c] - d[c] * radial) * inverse;
            }
        }
    }
}

impl Pass<'_> {
    /// Gradients of SH, gain and direction if every child has its own direction. `single`: no
    /// child has siblings, and SH sets are not written yet.
    #[inline(always)]
    pub(crate) fn child_colours<S: Simd>(
        &self,
        s: S,
        part: &mut Part,
        (at, single): (usize, bool),
        alive: u32,
        group: &mut Group,
        seen: &mut Directions,
    ) {
        if self.wide() {
            return self.child_colours_wide(s, part, at, alive, group, seen);
        }
        let children = self.splats.children_per_parent();
        let used = self.used();
        for l in 0..GROUP {
            let towards = minus(get(&group.mean, l), self.view.eye);
            put(&mut seen.towards, l, towards);
        }
        for l in lanes_of(alive) {
            let sh = sh_of_parent(self.splats, (part.first + at + l) / children);
            seen.weigh(l, used, sh, get(&group.sums, l)[6..9].try_into().unwrap_or_default());
        }
        seen.evaluate(used, self.options.sh_basis);
        let set = part.set;
        for l in 0..GROUP.min(part.len - at) {
            let p = (at + l) / children;
            let Some(sh) = part.sh.get_mut(p * set..(p + 1) * set) else { continue };
            if alive & (1 << l) == 0 {
                if single {
                    sh.fill(0.0);
                }
                continue;
            }
            let i = part.first + at + l;
            let gain = gain_of(self.splats, i);
            let rgb = [group.sums[6][l], group.sums[7][l], group.sums[8][l]];
            for c in 0..3 {
                group.d_mean[c][l] += gain * seen.slope[c][l];
            }
            let weighted = rgb.map(|v| gain * v);
            if single {
                seen.write_to(sh, l, used, weighted);
            } else {
                seen.add_to(sh, l, used, weighted);
            }
        }
        for l in 0..GROUP.min(part.len - at) {
            let value = if alive & (1 << l) != 0 { seen.value[l] } else { 0.0 };
            part.put_gain(at + l, value, [group.sums[6][l], group.sums[7][l], group.sums[8][l]]);
        }
    }

    /// Gradients of colours and gain without a direction. `single`: as of `child_colours`.
    #[inline(always)]
    pub(crate) fn plain_colours(
        &self,
        part: &mut Part,
        (at, single): (usize, bool),
        alive: u32,
        group: &Group,
    ) {
        let children = self.splats.children_per_parent();
        let set = part.set;
        for l in 0..GROUP.min(part.len - at) {
            let i = part.first + at + l;
            let seen = alive & (1 << l) != 0;
            let rgb: [f32; 3] = std::array::from_fn(|c| group.sums[6 + c][l]);
            let sh = sh_of_parent(self.splats, i / children);
            let value = rgb.iter().zip(sh).map(|(g, c)| g * c).sum();
            let gain = gain_of(self.splats, i);
            let p = (at + l) / children;
            if let Some(to) = part.sh.get_mut(p * set..(p + 1) * set) {
                if single {
                    to.fill(0.0);
                }
                if seen {
                    to.iter_mut().zip(rgb).for_each(|(to, g)| *to += gain * g);
                }
            }
            part.put_gain(at + l, if seen { value } else { 0.0 }, rgb);
        }
    }

    /// Returns whether [`WIDE`] coefficients of each SH set are used.
    pub(crate) fn wide(&self) -> bool {
        self.used() == WIDE
    }

    /// As `child_colours`, with [`WIDE`] coefficients. The first child of a parent writes its
    /// SH set, the others add to it.
    #[inline(always)]
    fn child_colours_wide<S: Simd>(
        &self,
        s: S,
        part: &mut Part,
        at: usize,
        alive: u32,
        group: &mut Group,
        seen: &mut Directions,
    ) {
        let children = self.splats.children_per_parent();
        let set = 3 * sh_coefficients(self.splats.sh_degree);
        // Dead lanes read the set of a live lane, whose numbers are finite.
        let spare = alive.trailing_zeros() as usize;
        let mut sets = [(part.first + at + spare) / children * set; GROUP];
        let mut gain = [0.0; GROUP];
        for l in lanes_of(alive) {
            sets[l] = (part.first + at + l) / children * set;
            gain[l] = part.gain_of(self.splats, at + l);
        }
        let eye = self.view.eye;
        for ((to, mean), eye) in seen.towards.iter_mut().zip(&group.mean).zip(eye) {
            s.store(s.load(mean) - s.splat(eye), to);
        }
        let [.., r, g, b, _] = &group.sums;
        seen.weigh_all(s, self.splats.sh, &sets, [r, g, b]);
        seen.evaluate(WIDE, self.options.sh_basis);
        let gains = s.load(&gain);
        let mut weighted = [[0.0; GROUP]; 3];
        for (c, weighted) in weighted.iter_mut().enumerate() {
            let moved = gains.fma(s.load(&seen.slope[c]), s.load(&group.d_mean[c]));
            s.store(moved, &mut group.d_mean[c]);
            s.store(gains * s.load(&group.sums[6 + c]), weighted);
        }
        let set = part.set;
        let new = if set > 0 { seen.spread(s, &weighted) } else { Default::default() };
        let (mut p, mut child) = (at / children, at % children);
        for (l, new) in new.iter().enumerate().take(part.len - at) {
            if let Some(sh) = part.sh.get_mut(p * set..(p + 1) * set) {
                let (used, unused) = sh.split_at_mut(set.min(3 * WIDE));
                if child == 0 {
                    used.copy_from_slice(&new.as_flattened()[..used.len()]);
                    unused.fill(0.0);
                } else if alive & (1 << l) != 0 {
                    for (to, new) in used.iter_mut().zip(new.as_flattened()) {
                        *to += new;
                    }
                }
            }
            child += 1;
            if child == children {
                (p, child) = (p + 1, 0);
            }
            let value = if alive & (1 << l) != 0 { seen.value[l] } else { 0.0 };
            part.put_gain(at + l, value, [group.sums[6][l], group.sums[7][l], group.sums[8][l]]);
        }
    }

    /// Gain where the children of a parent share its direction.
    #[inline(always)]
    pub(crate) fn parent_gains(&self, part: &mut Part, at: usize, count: usize, group: &Group) {
        let children = self.splats.children_per_parent();
        for l in 0..count {
            let rgb: [f32; 3] = std::array::from_fn(|c| group.sums[6 + c][l]);
            let radiance = self.radiance[(part.first + at + l) / children];
            let alive = rgb.iter().any(|&v| v != 0.0);
            let value = (0..3).map(|c| rgb[c] * radiance[c]).sum();
            part.put_gain(at + l, if alive { value } else { 0.0 }, rgb);
        }
    }

    /// SH and direction of every parent of `part`, the latter shared by its children.
    #[inline(always)]
    pub(crate) fn parent_colours(&self, part: &mut Part, seen: &mut Directions) {
        let children = self.splats.children_per_parent();
        let used = self.used();
        let set = part.set;
        let parents = part.len.div_ceil(children);
        for first in (0..parents).step_by(GROUP) {
            let mut weighted = [[0.0f32; 3]; GROUP];
            let mut count = [0.0f32; GROUP];
            let mut alive = 0;
            for l in 0..GROUP.min(parents - first) {
                let family = (first + l) * children..((first + l + 1) * children).min(part.len);
                let mut sum = [0.0f32; 3];
                for i in family.map(|j| part.first + j) {
                    let d = minus(self.splats.mean(i), self.view.eye);
                    if d.iter().all(|v| v.is_finite()) {
                        sum = [sum[0] + d[0], sum[1] + d[1], sum[2] + d[2]];
                        count[l] += 1.0;
                    }
                    if !self.footprints[i].visible() {
                        continue;
                    }
                    let gain = gain_of(self.splats, i);
                    let sums = self.sums_of(i);
                    for c in 0..3 {
                        weighted[l][c] += gain * sums[6 + c];
                    }
                }
                put(&mut seen.towards, l, sum.map(|v| v / count[l].max(1.0)));
                alive |= u32::from(weighted[l] != [0.0; 3]) << l;
            }
            for l in lanes_of(alive) {
                let p = part.first / children + first + l;
                seen.weigh(l, used, sh_of_parent(self.splats, p), weighted[l]);
            }
            seen.evaluate(used, self.options.sh_basis);
            for l in lanes_of(alive) {
                let p = first + l;
                if let Some(sh) = part.sh.get_mut(p * set..(p + 1) * set) {
                    seen.add_to(sh, l, used, weighted[l]);
                }
                let share = get(&seen.slope, l).map(|v: f32| v / count[l].max(1.0));
                for j in p * children..((p + 1) * children).min(part.len) {
                    let mean = self.splats.mean(part.first + j);
                    if minus(mean, self.view.eye).iter().all(|v| v.is_finite()) {
                        part.add_mean(j, share);
                    }
                }
            }
        }
    }

    fn used(&self) -> usize {
        used_coefficients(self.options.sh_basis, self.options.sh_degree.min(self.splats.sh_degree))
    }
}

#[inline(always)]
fn minus(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn sh_of_parent<'a>(splats: &SplatSlices<'a>, p: usize) -> &'a [f32] {
    let set = 3 * sh_coefficients(splats.sh_degree);
    splats.sh.get(p * set..(p + 1) * set).unwrap_or(&[])
}

/// γ of splat `i`.
#[inline(always)]
fn gain_of(splats: &SplatSlices, i: usize) -> f32 {
    let lanes = splats.gain.len() / splats.len().max(1);
    splats.gain.get(i * lanes).copied().filter(|_| lanes > 0).unwrap_or(1.0)
}

/// Positions of the set bits.
fn lanes_of(mask: u32) -> impl Iterator<Item = usize> {
    (0..GROUP).filter(move |l| mask & (1 << l) != 0)
}
