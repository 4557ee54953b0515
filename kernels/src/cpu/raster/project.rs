//! Projection of all splats: geometry to footprints, SH to colour, in parallel over
//! chunks of splats.
//!
//! In: [`SplatSlices`] in world frame. Out: one [`Footprint`] per splat (empty where
//! dropped, see [`crate::cpu::raster::ewa`]), and the input of [`crate::cpu::raster::tiles`] for their
//! lists. Each lane is a splat. The kernel computes the geometry of all splats, then the colour
//! of the kept ones, and reads no other coefficients.
//! Colour of child i of parent p: max(0, ½ + γ_i·Σ_k sh_{p,k} Y_k(d) + δ_i)
//! (SubSplat, colour gain; 3DGS for γ = 1, δ = 0).

pub use crate::layout::{Geometry, SplatSlices};

use crate::cpu::raster::covariance::Shape;
use crate::cpu::raster::ewa::{FIELDS, Footprint, View};
use crate::cpu::raster::sh::{ShFunctions, direction_lanes, radiance_lanes};
use crate::cpu::raster::tiles::{ChunkCover, TileLists};
use crate::cpu::simd::{Kernel, LANES, Mask, Simd, SimdLevel, Vector};
pub(crate) use crate::layout::floats_at;
use crate::layout::{
    MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, RasterOptions, SCALE_OFFSET, SPLAT_STRIDE,
    ShDirection, sh_coefficients,
};
use rayon::prelude::*;

/// Parents per unit of parallel work.
const PARENTS: usize = 256;

const _: () = assert!(OPACITY_OFFSET == SCALE_OFFSET + 3 && QUAT_OFFSET == MEAN_OFFSET + 3);

/// Footprints of a frame, reused from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct Projection {
    /// `[N]`.
    pub(crate) footprints: Vec<Footprint>,
    /// `[P]`: Σ sh·Y at each parent's direction ([`ShDirection::Parent`] only).
    pub(crate) parents: Vec<[f32; 3]>,
}

impl Projection {
    /// Bytes held.
    pub(crate) fn bytes(&self) -> usize {
        self.footprints.capacity() * size_of::<Footprint>()
            + self.parents.capacity() * size_of::<[f32; 3]>()
    }

    /// Counts the entries of existing footprints.
    pub(crate) fn cover(&self, lists: &mut TileLists) {
        let chunk = lists.chunk();
        let covers = lists.chunks(self.footprints.len());
        let chunks = self.footprints.par_chunks(chunk).zip(covers);
        chunks.enumerate().for_each(|(c, (footprints, mut cover))| {
            cover.clear();
            for (i, f) in footprints.iter().enumerate().filter(|(_, f)| f.visible()) {
                cover.add(f, (c * chunk + i) as u32);
            }
        });
    }

    /// Projects all splats and counts their entries in the lists of `lists`' tiles.
    pub(crate) fn run(
        &mut self,
        level: SimdLevel,
        splats: &SplatSlices,
        view: &View,
        options: &RasterOptions,
        lists: &mut TileLists,
    ) {
        let degree = options.sh_degree.min(splats.sh_degree);
        let functions = ShFunctions { basis: options.sh_basis, degree };
        let shared = options.sh_direction == ShDirection::Parent;
        let plain = options.sh_direction == ShDirection::Colour;
        self.parents.clear();
        if shared {
            let children = splats.children_per_parent();
            let parents = splats.parents().max(splats.len().div_ceil(children));
            self.parents.resize(parents, [0.0; 3]);
            self.parents.par_chunks_mut(PARENTS).enumerate().for_each(|(c, out)| {
                level.run(Parents { splats, view, functions, first: c * PARENTS, out });
            });
        }
        self.footprints.resize(splats.len(), Footprint::default());
        let parents = shared.then_some(&self.parents[..]);
        let chunk = lists.chunk();
        let chunks = self.footprints.par_chunks_mut(chunk).zip(lists.chunks(splats.len()));
        chunks.enumerate().for_each(|(c, (footprints, cover))| {
            level.run(Chunk {
                splats,
                view,
                functions,
                parents,
                plain,
                first: c * chunk,
                footprints,
                cover,
            });
        });
    }
}

/// Computes Σ sh·Y of some parents along the mean of their children's finite means.
struct Parents<'a> {
    splats: &'a SplatSlices<'a>,
    view: &'a View,
    functions: ShFunctions,
    /// First parent.
    first: usize,
    out: &'a mut [[f32; 3]],
}

impl Kernel for Parents<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (splats, eye) = (self.splats, self.view.eye);
        let (children, n) = (splats.children_per_parent(), splats.len());
        let set = 3 * sh_coefficients(splats.sh_degree);
        let mut buffer = [[0.0; LANES]; 3];
        for (g, out) in self.out.chunks_mut(LANES).enumerate() {
            let mut at = [0; LANES];
            for l in 0..out.len() {
                let p = self.first + g * LANES + l;
                at[l] = p * set;
                let (mut sum, mut count) = ([0.0f32; 3], 0.0f32);
                for i in p * children..((p + 1) * children).min(n) {
                    let m = splats.mean(i);
                    let d = [m[0] - eye[0], m[1] - eye[1], m[2] - eye[2]];
                    if d.iter().all(|v| v.is_finite()) {
                        sum = [sum[0] + d[0], sum[1] + d[1], sum[2] + d[2]];
                        count += 1.0;
                    }
                }
                for (lanes, v) in buffer.iter_mut().zip(sum) {
                    lanes[l] = v / count.max(1.0);
                }
            }
            let d = [s.load(&buffer[0]), s.load(&buffer[1]), s.load(&buffer[2])];
            let d = direction_lanes(s, d);
            let rgb = radiance_lanes(s, self.functions, d, splats.sh, &at);
            for (lanes, v) in buffer.iter_mut().zip(rgb) {
                s.store(v, lanes);
            }
            for (l, out) in out.iter_mut().enumerate() {
                *out = [buffer[0][l], buffer[1][l], buffer[2][l]];
            }
        }
    }
}

/// Splats per pass of geometry, then colour: their footprints stay in the first-level cache.
const STRIP: usize = 256;

/// Projects one chunk of splats to footprints.
struct Chunk<'a> {
    splats: &'a SplatSlices<'a>,
    view: &'a View,
    functions: ShFunctions,
    parents: Option<&'a [[f32; 3]]>,
    /// SH sets are colours ([`ShDirection::Colour`]).
    plain: bool,
    /// First splat.
    first: usize,
    footprints: &'a mut [Footprint],
    cover: ChunkCover<'a>,
}

impl Kernel for Chunk<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self, s: S) {
        self.cover.clear();
        let mut kept = [0u32; STRIP + LANES];
        let mut start = 0;
        while start < self.footprints.len() {
            let past = (start + STRIP).min(self.footprints.len());
            let count = self.geometry(s, start, past, &mut kept);
            // The last group repeats a splat of the chunk.
            let last = kept[count.saturating_sub(1)];
            kept[count..count + LANES].fill(last);
            let mut g = 0;
            while g < count {
                self.prefetch(s, &kept[(g + AHEAD).min(count)..(g + AHEAD + LANES).min(count)]);
                let (group, _) = kept[g..].split_at(LANES);
                self.colour(s, group, (count - g).min(LANES));
                g += LANES;
            }
            for &i in &kept[..count] {
                let f = &self.footprints[i as usize];
                if f.visible() {
                    self.cover.add(f, self.first as u32 + i);
                }
            }
            start = past;
        }
    }
}

/// Distance of prefetches of coefficients, splats.
const AHEAD: usize = 2 * LANES;

impl Chunk<'_> {
    /// Prefetches the SH sets of some splats of the chunk.
    #[inline(always)]
    fn prefetch<S: Simd>(&self, s: S, group: &[u32]) {
        /// Floats of a cache line.
        const LINE: usize = 16;
        if self.parents.is_some() {
            return;
        }
        let set = 3 * sh_coefficients(self.splats.sh_degree);
        let children = self.splats.children_per_parent();
        let mut last = usize::MAX;
        for &i in group {
            let i = self.first + i as usize;
            let p = if children == 1 { i } else { i / children };
            if p != last {
                for at in (p * set..(p + 1) * set).step_by(LINE) {
                    if let Some(v) = self.splats.sh.get(at) {
                        s.prefetch(v);
                    }
                }
                last = p;
            }
        }
    }

    /// Computes footprints without colour of the chunk's splats `start..past`. Writes the
    /// indices of the kept ones to `kept` and returns their number.
    #[inline(always)]
    fn geometry<S: Simd>(
        &mut self,
        s: S,
        start: usize,
        past: usize,
        kept: &mut [u32; STRIP + LANES],
    ) -> usize {
        let (mut count, mut g) = (0, start);
        while g < past {
            let lanes = (past - g).min(LANES);
            let (fields, mask) = self.group(s, self.first + g, lanes);
            let bits = mask.to_bits() & (u32::MAX >> (32 - lanes));
            if bits == 0 {
                self.footprints[g..g + lanes].fill(Footprint::default());
            } else {
                let rows = s.transpose(fields);
                for (l, f) in self.footprints[g..g + lanes].iter_mut().enumerate() {
                    s.store(rows[l], f.fields_mut());
                }
                let mut rest = bits;
                while rest != 0 {
                    kept[count] = g as u32 + rest.trailing_zeros();
                    count += 1;
                    rest &= rest - 1;
                }
            }
            g += LANES;
        }
        count
    }

    /// Projects splats `first..first + lanes`.
    #[inline(always)]
    fn group<S: Simd>(&self, s: S, first: usize, lanes: usize) -> ([S::F; FIELDS], S::M) {
        let mut index = [first; LANES];
        for (l, i) in index.iter_mut().enumerate() {
            *i += l.min(lanes - 1);
        }
        match self.splats.geometry {
            Geometry::Packed(rows) => {
                let at = index.map(|i| i * SPLAT_STRIDE);
                let [x, y, z, qw] = s.gather4(rows, &at, MEAN_OFFSET);
                let [qx, qy, qz, _] = s.gather4(rows, &at, QUAT_OFFSET + 1);
                // The row's last four.
                let [sx, sy, sz, opacity] = s.gather4(rows, &at, SCALE_OFFSET);
                let shape = Shape::Quat([qw, qx, qy, qz], [sx, sy, sz]);
                self.view.project(s, [x, y, z], shape, opacity)
            }
            Geometry::Cov6 { cov6, opacities, .. } => {
                let mut columns = [[0.0; LANES]; 4];
                let mut shapes = [[0.0; 6]; LANES];
                for (l, &i) in index.iter().enumerate() {
                    let [x, y, z] = self.splats.mean(i);
                    for (column, v) in columns.iter_mut().zip([x, y, z, opacities[i]]) {
                        column[l] = v;
                    }
                    shapes[l] = floats_at(cov6, 6 * i);
                }
                let [x, y, z, opacity] = columns;
                let mean = [s.load(&x), s.load(&y), s.load(&z)];
                self.view.project(s, mean, Shape::Cov6(&shapes), s.load(&opacity))
            }
            Geometry::Separate { quats, scales, opacities, .. } => {
                let mut columns = [[0.0; LANES]; 11];
                for (l, &i) in index.iter().enumerate() {
                    let [x, y, z] = self.splats.mean(i);
                    let [qw, qx, qy, qz] = floats_at(quats, 4 * i);
                    let [sx, sy, sz] = floats_at(scales, 3 * i);
                    let row = [x, y, z, qw, qx, qy, qz, sx, sy, sz, opacities[i]];
                    for (column, v) in columns.iter_mut().zip(row) {
                        column[l] = v;
                    }
                }
                let [x, y, z, qw, qx, qy, qz, sx, sy, sz, opacity] = columns.map(|v| s.load(&v));
                let shape = Shape::Quat([qw, qx, qy, qz], [sx, sy, sz]);
                self.view.project(s, [x, y, z], shape, opacity)
            }
        }
    }

    /// Colours the first `count` splats of `group`; drops those whose colour is not finite.
    #[inline(always)]
    fn colour<S: Simd>(&mut self, s: S, group: &[u32], count: usize) {
        let splats = self.splats;
        let children = splats.children_per_parent();
        let mut index = [self.first; LANES];
        for (i, g) in index.iter_mut().zip(group) {
            *i += *g as usize;
        }
        let mut lanes = [[0.0; LANES]; 4];
        let sum = if let Some(parents) = self.parents {
            for (l, i) in index.iter().enumerate() {
                let rgb = parents.get(i / children).copied().unwrap_or([0.0; 3]);
                (lanes[0][l], lanes[1][l], lanes[2][l]) = (rgb[0], rgb[1], rgb[2]);
            }
            [s.load(&lanes[0]), s.load(&lanes[1]), s.load(&lanes[2])]
        } else if self.plain {
            let set = 3 * sh_coefficients(splats.sh_degree);
            for (l, i) in index.iter().enumerate() {
                let [r, g, b] = floats_at(splats.sh, i / children * set);
                (lanes[0][l], lanes[1][l], lanes[2][l]) = (r, g, b);
            }
            [s.load(&lanes[0]), s.load(&lanes[1]), s.load(&lanes[2])]
        } else {
            let set = 3 * sh_coefficients(splats.sh_degree);
            let mean = match splats.geometry {
                Geometry::Packed(rows) => {
                    let [x, y, z, _] =
                        s.gather4(rows, &index.map(|i| i * SPLAT_STRIDE), MEAN_OFFSET);
                    [x, y, z]
                }
                Geometry::Cov6 { .. } | Geometry::Separate { .. } => {
                    for (l, &i) in index.iter().enumerate() {
                        let m = splats.mean(i);
                        (lanes[0][l], lanes[1][l], lanes[2][l]) = (m[0], m[1], m[2]);
                    }
                    [s.load(&lanes[0]), s.load(&lanes[1]), s.load(&lanes[2])]
                }
            };
            let eye = self.view.eye;
            let away =
                [mean[0] - s.splat(eye[0]), mean[1] - s.splat(eye[1]), mean[2] - s.splat(eye[2])];
            let d = direction_lanes(s, away);
            let at = if children == 1 { index } else { index.map(|i| i / children) };
            radiance_lanes(s, self.functions, d, splats.sh, &at.map(|p| p * set))
        };
        let (gain, residual) = self.gain(s, &index);
        let (half, least) = if self.plain { (0.0, f32::NEG_INFINITY) } else { (0.5, 0.0) };
        let (half, least) = (s.splat(half), s.splat(least));
        let infinity = s.splat(f32::INFINITY);
        let mut good = half.lt(infinity);
        for c in 0..3 {
            let v = gain.fma(sum[c], half) + residual[c];
            good = good & v.abs().lt(infinity);
            s.store(least.max(v), &mut lanes[c]);
        }
        let good = good.to_bits();
        for (l, &i) in group[..count].iter().enumerate() {
            let f = &mut self.footprints[i as usize];
            if good & (1 << l) != 0 {
                f.rgb = [lanes[0][l], lanes[1][l], lanes[2][l]];
            } else {
                *f = Footprint::default();
            }
        }
    }

    /// Loads γ and δ.
    #[inline(always)]
    fn gain<S: Simd>(&self, s: S, index: &[usize; LANES]) -> (S::F, [S::F; 3]) {
        let gain = self.splats.gain;
        let n = self.splats.len();
        let none = [s.splat(0.0); 3];
        if gain.is_empty() {
            (s.splat(1.0), none)
        } else if gain.len() == 4 * n {
            let [gain, r, g, b] = s.gather4(gain, &index.map(|i| 4 * i), 0);
            (gain, [r, g, b])
        } else {
            let one = index.map(|i| gain.get(i).copied().unwrap_or(1.0));
            (s.load(&one), none)
        }
    }
}
