//! Common parts of the splat readers and writers: single Gaussians in the form of the files,
//! changes of axes for means, quaternions and SH, and checks.
//!
//! Writers fold a child's colour into SH coefficients of its own: γ·h of its parent, δ/C₀
//! added to the constant one, in the standard basis, truncated to the degree written.
//! Readers give K = 1, no gain, the standard basis and unit quaternions.
//!
//! Readers leave out what no writer means, and say so in a note: a Gaussian with a number that is
//! NaN or infinite, and one with a quaternion of zeros. The second is a row that was never
//! written: a trainer that stopped, or a file allocated for more rows than it got. Drawn, such
//! rows are a fog at the origin (σ = e⁰, opacity ½). splat-transform leaves them out too
//! (its pull request 288). A file of nothing else is an error.

use super::SaveOptions;
use crate::files::{Error, Result};
use crate::scene::splats::{SplatParts, Splats};
use glam::{DMat3, DQuat, DVec3};
use std::ops::Range;
use std::path::Path;
use subsplat_kernels::layout::{
    OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE, ShBasis, sh_coefficients,
};
use subsplat_kernels::sh::{C0, Rotation, RotationBasis, standard_from_mvsplat};

/// Smallest σ that is written, world units: its logarithm is finite.
pub(super) const SCALE_MIN: f32 = 1e-12;
/// Distance from 0 and 1 to which opacities are clamped for files that store logits.
const LOGIT_MARGIN: f64 = 1e-7;
/// Largest distance of an opacity from [0, 1] by rounding; more is an error.
const OPACITY_SLACK: f32 = 1e-4;

/// A Gaussian in the form of a file.
pub(super) struct Gaussian {
    /// Mean, axes of the file.
    pub mean: [f32; 3],
    /// Unit quaternion wxyz, axes of the file.
    pub quat: [f32; 4],
    /// σ, at least [`SCALE_MIN`].
    pub scale: [f32; 3],
    /// Opacity in [0, 1].
    pub opacity: f32,
    /// `[D, 3]`, standard basis, RGB innermost; zero beyond the degree written.
    pub sh: [f32; 75],
}

/// An entry of a sparse matrix row.
struct Entry {
    column: usize,
    factor: f64,
}

/// Sparse rows of a linear map on SH coefficients.
type ShMap = Vec<Vec<Entry>>;

/// A change of axes, as a matrix and as a quaternion.
struct AxisRotation {
    matrix: DMat3,
    quat: DQuat,
}

/// Splats to be written to a file.
pub(super) struct Outgoing<'a> {
    splats: &'a Splats,
    min_opacity: f32,
    /// Largest coordinate that the format holds.
    reach: f64,
    rotation: Option<AxisRotation>,
    map: Option<ShMap>,
    /// Degree written.
    pub sh_degree: usize,
    /// Gaussians written.
    pub count: usize,
    /// Gaussians under the least opacity.
    pub pruned: usize,
    /// Gaussians of enough opacity with a coordinate beyond the format's range, which are left out.
    pub out_of_range: usize,
    /// Gaussians of which a σ was raised to [`SCALE_MIN`].
    pub clamped_scales: usize,
    /// Smallest and largest mean, axes of the file.
    pub bounds: [[f32; 3]; 2],
}

impl<'a> Outgoing<'a> {
    /// Checks every number of `splats` and counts the Gaussians that will be written: those of enough opacity
    /// whose coordinates are at most `reach`. `rotation` maps the world's axes to the file's; `path` is for errors.
    ///
    /// # Errors
    /// A number that is not finite, an opacity out of [0, 1], no Gaussian to write, more than half beyond `reach`.
    pub fn new(
        splats: &'a Splats,
        options: &SaveOptions,
        rotation: Option<DMat3>,
        degree_limit: usize,
        reach: f64,
        path: &Path,
    ) -> Result<Self> {
        let wanted = options.sh_degree.unwrap_or(3);
        let sh_degree = wanted.min(splats.sh_degree).min(degree_limit);
        let d_in = splats.sh_coefficients();
        let map = sh_map(splats.sh_basis, rotation, d_in, sh_coefficients(sh_degree));
        let rotation =
            rotation.map(|matrix| AxisRotation { matrix, quat: DQuat::from_mat3(&matrix) });
        let min_opacity = options.min_opacity;
        if !(0.0..=1.0).contains(&min_opacity) {
            return Err(Error::format(path, "a least opacity in [0, 1]", min_opacity.to_string()));
        }
        let mut out = Self {
            splats,
            min_opacity,
            reach,
            rotation,
            map,
            sh_degree,
            count: 0,
            pruned: 0,
            out_of_range: 0,
            clamped_scales: 0,
            bounds: [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]],
        };
        out.survey(path)?;
        if out.out_of_range > out.count {
            let all = out.count + out.out_of_range;
            let got = format!("{} of {all} beyond that", out.out_of_range);
            return Err(Error::format(path, format!("coordinates within {reach} units"), got));
        }
        if out.count == 0 {
            let got = format!("none (of {}, least opacity {min_opacity})", splats.len());
            return Err(Error::format(path, "at least one Gaussian to write", got));
        }
        Ok(out)
    }

    fn survey(&mut self, path: &Path) -> Result<()> {
        check_finite(self.splats, path)?;
        for i in 0..self.splats.len() {
            let opacity = self.splats.opacity(i);
            if !(-OPACITY_SLACK..=1.0 + OPACITY_SLACK).contains(&opacity) {
                let got = opacity.to_string();
                return Err(
                    Error::format(path, "an opacity in [0, 1]", got).at(format!(" splat {i}"))
                );
            }
            if !self.keeps(i) {
                let opaque = self.is_opaque(i);
                *if opaque { &mut self.out_of_range } else { &mut self.pruned } += 1;
                continue;
            }
            self.count += 1;
            self.clamped_scales += usize::from(self.splats.scale(i).iter().any(|s| *s < SCALE_MIN));
            let mean = self.mean(i);
            for (axis, m) in mean.into_iter().enumerate() {
                self.bounds[0][axis] = self.bounds[0][axis].min(m);
                self.bounds[1][axis] = self.bounds[1][axis].max(m);
            }
        }
        Ok(())
    }

    /// Iterates over the indices of the Gaussians that are written.
    pub fn kept(&self) -> impl Iterator<Item = usize> {
        self.kept_of(0..self.len())
    }

    /// Those of the splats `range` that will be written.
    pub fn kept_of(&self, range: Range<usize>) -> impl Iterator<Item = usize> {
        range.filter(|&i| self.keeps(i))
    }

    /// Number of splats, with those that will not be written.
    pub fn len(&self) -> usize {
        self.splats.len()
    }

    /// All splats as runs of `len`, the last one shorter.
    pub fn runs(&self, len: usize) -> impl Iterator<Item = Range<usize>> {
        let n = self.len();
        (0..n).step_by(len).map(move |first| first..(first + len).min(n))
    }

    fn keeps(&self, i: usize) -> bool {
        let mean = self.splats.mean(i);
        self.is_opaque(i) && mean.into_iter().all(|v| f64::from(v.abs()) <= self.reach)
    }

    fn is_opaque(&self, i: usize) -> bool {
        // Rounding may leave an opacity slightly below zero.
        self.splats.opacity(i).max(0.0) >= self.min_opacity
    }

    /// Returns the mean of Gaussian `i` in the axes of the file.
    pub fn mean(&self, i: usize) -> [f32; 3] {
        let mean = self.splats.mean(i);
        match &self.rotation {
            None => mean,
            Some(r) => (r.matrix * DVec3::from(mean.map(f64::from))).as_vec3().to_array(),
        }
    }

    /// Makes a visitor with scratch space. It maps a parent's SH once for successive
    /// children.
    pub fn visitor(&self) -> Visitor<'_> {
        let gaussian = Gaussian {
            mean: [0.0; 3],
            quat: [0.0; 4],
            scale: [0.0; 3],
            opacity: 0.0,
            sh: [0.0; 75],
        };
        Visitor { out: self, parent: None, parent_sh: [0.0; 75], gaussian }
    }
}

/// Converts splats of an [`Outgoing`] to [`Gaussian`]s.
pub(super) struct Visitor<'a> {
    out: &'a Outgoing<'a>,
    parent: Option<usize>,
    parent_sh: [f32; 75],
    gaussian: Gaussian,
}

impl Visitor<'_> {
    /// Converts Gaussian `i` of the splats to the form of the file.
    pub fn at(&mut self, i: usize) -> std::io::Result<&Gaussian> {
        let s = self.out.splats;
        let g = &mut self.gaussian;
        g.mean = self.out.mean(i);
        let mut q = s.quat_wxyz(i);
        if let Some(r) = &self.out.rotation {
            q = wxyz(r.quat * quat(q));
        }
        g.quat = unit(q);
        g.scale = s.scale(i).map(|v| v.max(SCALE_MIN));
        g.opacity = s.opacity(i).clamp(0.0, 1.0);
        let parent = i / s.children_per_parent();
        let floats = 3 * sh_coefficients(self.out.sh_degree);
        if self.parent != Some(parent) {
            self.parent = Some(parent);
            apply_map(self.out.map.as_ref(), s.sh_of(i), &mut self.parent_sh[..floats]);
        }
        let (gamma, delta) = s.gain_of(i);
        for (v, h) in g.sh[..floats].iter_mut().zip(&self.parent_sh) {
            *v = gamma * h;
        }
        for (v, d) in g.sh.iter_mut().zip(delta) {
            *v = (f64::from(*v) + f64::from(d) / C0) as f32;
        }
        if g.sh[..floats].iter().chain(&g.mean).all(|v| v.is_finite()) {
            Ok(&self.gaussian)
        } else {
            Err(std::io::Error::other(format!(
                "splat {i}: expected finite numbers, got an overflow of gain times SH or of the mean"
            )))
        }
    }
}

/// Computes the map from `d_in` coefficients in `basis` to `d_out` standard ones of the
/// rotated function; `None` for the identity.
fn sh_map(basis: ShBasis, rotation: Option<DMat3>, d_in: usize, d_out: usize) -> Option<ShMap> {
    if rotation.is_none() && basis == ShBasis::Standard {
        return None;
    }
    let mut base = vec![0.0; d_in * d_in];
    match basis {
        ShBasis::Standard => (0..d_in).for_each(|i| base[i * d_in + i] = 1.0),
        ShBasis::Mvsplat => {
            let m = standard_from_mvsplat();
            let used = d_in.min(16);
            for i in 0..used {
                base[i * d_in..i * d_in + used].copy_from_slice(&m[i * 16..i * 16 + used]);
            }
        }
    }
    let rotation = rotation.unwrap_or(DMat3::IDENTITY);
    let rotated = Rotation::new(rotation, RotationBasis::Standard).matrix(4);
    let row = |i: usize| {
        let factor = |j: usize| -> f64 {
            let v = (0..d_in).map(|k| rotated[i * 25 + k] * base[k * d_in + j]).sum::<f64>();
            // Rotations by 90° and 180° permute and negate coefficients: rounding is undone.
            if (v - v.round()).abs() < 1e-12 { v.round() } else { v }
        };
        let entries = (0..d_in).map(|column| Entry { column, factor: factor(column) });
        entries.filter(|e| e.factor != 0.0).collect()
    };
    Some((0..d_out).map(row).collect())
}

fn apply_map(map: Option<&ShMap>, from: &[f32], to: &mut [f32]) {
    match map {
        None => to.copy_from_slice(&from[..to.len()]),
        Some(map) => {
            for (out, row) in to.chunks_exact_mut(3).zip(map) {
                for (c, v) in out.iter_mut().enumerate() {
                    let term = |e: &Entry| e.factor * f64::from(from[3 * e.column + c]);
                    *v = row.iter().map(term).sum::<f64>() as f32;
                }
            }
        }
    }
}

/// A similarity transform: x ↦ s·R·x + t.
pub(super) struct Similarity {
    /// s, above 0.
    pub scale: f64,
    /// R, a proper rotation.
    pub rotation: DMat3,
    /// t.
    pub translation: DVec3,
}

/// Rotation by 180° about x, between y-down, z-forward and y-up, z-backward axes.
pub(super) const HALF_TURN_X: DMat3 =
    DMat3 { x_axis: DVec3::X, y_axis: DVec3::NEG_Y, z_axis: DVec3::NEG_Z };

/// Transforms splats of the standard basis without a gain.
pub(super) fn transform(splats: &mut Splats, by: &Similarity) {
    let rotates = (by.rotation - DMat3::IDENTITY).to_cols_array().iter().any(|v| v.abs() > 1e-9);
    if !rotates && by.translation == DVec3::ZERO && by.scale == 1.0 {
        return;
    }
    let q = DQuat::from_mat3(&by.rotation);
    for row in splats.rows.chunks_exact_mut(SPLAT_STRIDE) {
        let mean = DVec3::new(f64::from(row[0]), f64::from(row[1]), f64::from(row[2]));
        let moved = by.scale * (by.rotation * mean) + by.translation;
        row[..3].copy_from_slice(&moved.as_vec3().to_array());
        if rotates {
            let stored = [
                row[QUAT_OFFSET],
                row[QUAT_OFFSET + 1],
                row[QUAT_OFFSET + 2],
                row[QUAT_OFFSET + 3],
            ];
            row[QUAT_OFFSET..QUAT_OFFSET + 4].copy_from_slice(&wxyz(q * quat(stored)));
        }
        for s in &mut row[SCALE_OFFSET..SCALE_OFFSET + 3] {
            *s = (by.scale * f64::from(*s)) as f32;
        }
    }
    let d = splats.sh_coefficients();
    if rotates && d > 1 {
        let map = sh_map(ShBasis::Standard, Some(by.rotation), d, d);
        let mut set = vec![0.0; 3 * d];
        for sh in splats.sh.chunks_exact_mut(3 * d) {
            set.copy_from_slice(sh);
            apply_map(map.as_ref(), &set, sh);
        }
    }
}

fn quat(wxyz: [f32; 4]) -> DQuat {
    let [w, x, y, z] = wxyz.map(f64::from);
    DQuat::from_xyzw(x, y, z, w)
}

fn wxyz(q: DQuat) -> [f32; 4] {
    [q.w as f32, q.x as f32, q.y as f32, q.z as f32]
}

/// Normalises `q` for a file. The zero quaternion becomes the identity, as in the 3DGS kernels;
/// one that is not finite stays as it is.
pub(super) fn unit(q: [f32; 4]) -> [f32; 4] {
    let norm = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    if norm == 0.0 {
        return [1.0, 0.0, 0.0, 0.0];
    }
    if !norm.is_finite() {
        return q;
    }
    q.map(|v| (f64::from(v) / norm) as f32)
}

/// Computes the opacity before the sigmoid; 0 and 1 are clamped by 1e-7.
pub(super) fn logit(opacity: f32) -> f32 {
    let a = f64::from(opacity).clamp(LOGIT_MARGIN, 1.0 - LOGIT_MARGIN);
    (a / (1.0 - a)).ln() as f32
}

/// Computes the opacity after the sigmoid; ±∞ give 1 and 0.
pub(super) fn sigmoid(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

/// Computes the coefficient of the constant function for a display colour in [0, 1].
pub(super) fn dc_from_colour(colour: f64) -> f32 {
    ((colour - 0.5) / C0) as f32
}

/// Gaussians that a reader collects.
pub(super) struct Incoming {
    rows: Vec<f32>,
    sh: Vec<f32>,
    sh_degree: usize,
}

impl Incoming {
    /// Allocates for `count` Gaussians; the caller has compared `count` with the bytes.
    pub fn with_capacity(count: usize, sh_degree: usize) -> Self {
        let set = 3 * sh_coefficients(sh_degree);
        Self {
            rows: Vec::with_capacity(count * SPLAT_STRIDE),
            sh: Vec::with_capacity(count * set),
            sh_degree,
        }
    }

    /// Appends one Gaussian with a zeroed SH set, and returns the set `[D, 3]`. A quaternion of
    /// zeros stays: [`Decoded::new`] leaves the Gaussian out.
    pub fn push(
        &mut self,
        mean: [f32; 3],
        quat: [f32; 4],
        scale: [f32; 3],
        opacity: f32,
    ) -> &mut [f32] {
        self.rows.extend(mean);
        self.rows.extend(if quat == NO_ROTATION { quat } else { unit(quat) });
        self.rows.extend(scale);
        self.rows.push(opacity);
        let start = self.sh.len();
        self.sh.resize(start + 3 * sh_coefficients(self.sh_degree), 0.0);
        &mut self.sh[start..]
    }

    /// Returns the SH set of Gaussian `i`, `[D, 3]`.
    pub fn sh_mut(&mut self, i: usize) -> Option<&mut [f32]> {
        let set = 3 * sh_coefficients(self.sh_degree);
        self.sh.get_mut(i * set..(i + 1) * set)
    }

    /// Raises the SH degree to `degree`, with zeros in the Gaussians so far.
    pub fn raise_degree(&mut self, degree: usize) {
        if degree <= self.sh_degree {
            return;
        }
        let [before, after] = [self.sh_degree, degree].map(|d| 3 * sh_coefficients(d));
        let count = self.rows.capacity() / SPLAT_STRIDE;
        let mut raised = Vec::with_capacity(count * after);
        for set in self.sh.chunks_exact(before) {
            raised.extend_from_slice(set);
            raised.resize(raised.len() + after - before, 0.0);
        }
        (self.sh, self.sh_degree) = (raised, degree);
    }

    /// Makes a set of all Gaussians. Their numbers may be NaN or infinite, their quaternions zero.
    pub fn into_splats(self, path: &Path) -> Result<Splats> {
        let Self { rows, sh, sh_degree } = self;
        let gain = Vec::new();
        let sh_basis = ShBasis::Standard;
        Splats::with_unchecked_numbers(SplatParts { rows, sh, gain, sh_degree, sh_basis })
            .map_err(|e| Error::format(path, "Gaussians of one shape", e.to_string()))
    }
}

/// Quaternion that stands for no rotation, not the identity: no orientation at all.
const NO_ROTATION: [f32; 4] = [0.0; 4];

/// The decoded content of a file.
pub(super) struct Decoded {
    /// The Gaussians: finite numbers, unit quaternions.
    pub splats: Splats,
    /// Flavour: `ply binary_little_endian`, `spz 3`.
    pub flavour: String,
    /// Comments of the file.
    pub comments: Vec<String>,
    /// Lines about what reading applied or did not read.
    pub notes: Vec<String>,
    /// Gaussians that were left out because a number is NaN or infinite.
    pub non_finite: usize,
    /// Gaussians that were left out because their quaternion is zero.
    pub zero_rows: usize,
}

impl Decoded {
    /// Leaves out the Gaussians that no writer means, with a note for each of the two reasons after
    /// `notes`. `splats` are those of a reader: K = 1, no gain.
    ///
    /// # Errors
    /// No Gaussian is left, of one or more.
    pub fn new(
        mut splats: Splats,
        flavour: String,
        comments: Vec<String>,
        mut notes: Vec<String>,
        path: &Path,
    ) -> Result<Self> {
        let (all, set) = (splats.len(), 3 * splats.sh_coefficients());
        let (mut kept, mut zero_rows, mut non_finite) = (0, 0, 0);
        // The first Gaussian of each reason.
        let (mut first_zero, mut first_non_finite) = (0, String::new());
        for i in 0..all {
            let row = i * SPLAT_STRIDE..(i + 1) * SPLAT_STRIDE;
            let sh = i * set..(i + 1) * set;
            let found = not_finite(&splats.rows[row.clone()]).or_else(|| {
                let bad = splats.sh[sh.clone()].iter().find(|v| !v.is_finite());
                bad.map(|v| ("SH coefficient", *v))
            });
            if let Some((what, v)) = found {
                if non_finite == 0 {
                    first_non_finite = format!("splat {i} ({what} {v})");
                }
                non_finite += 1;
                continue;
            }
            if splats.quat_wxyz(i) == NO_ROTATION {
                if zero_rows == 0 {
                    first_zero = i;
                }
                zero_rows += 1;
                continue;
            }
            if kept < i {
                splats.rows.copy_within(row, kept * SPLAT_STRIDE);
                splats.sh.copy_within(sh, kept * set);
            }
            kept += 1;
        }
        splats.rows.truncate(kept * SPLAT_STRIDE);
        splats.sh.truncate(kept * set);
        let mut reasons = Vec::new();
        if zero_rows > 0 {
            reasons.push(format!(
                "{zero_rows} of {all} splats, whose rotation is 0 0 0 0 (rows that were never \
                 written?); the first is splat {first_zero}"
            ));
        }
        if non_finite > 0 {
            reasons.push(format!(
                "{non_finite} of {all} splats, which hold numbers that are NaN or infinite; the \
                 first is {first_non_finite}"
            ));
        }
        if all > 0 && kept == 0 {
            let expected = "a splat with finite numbers and a rotation";
            return Err(Error::format(path, expected, format!("only {}", reasons.join("; and "))));
        }
        notes.extend(reasons.into_iter().map(|reason| format!("left out: {reason}")));
        Ok(Self { splats, flavour, comments, notes, non_finite, zero_rows })
    }
}

/// Returns the first number of a packed row that is NaN or infinite, with the name of its field.
fn not_finite(row: &[f32]) -> Option<(&'static str, f32)> {
    let offset = row.iter().position(|v| !v.is_finite())?;
    let what = match offset {
        0..QUAT_OFFSET => "mean",
        QUAT_OFFSET..SCALE_OFFSET => "quaternion",
        SCALE_OFFSET..OPACITY_OFFSET => "scale",
        _ => "opacity",
    };
    Some((what, row[offset]))
}

/// Refuses the first Gaussian with a number that is not finite.
fn check_finite(splats: &Splats, path: &Path) -> Result<()> {
    let refuse = |i: usize, what: &str, v: f32| {
        let got = format!("{what} {v}");
        Err(Error::format(path, "finite numbers", got).at(format!(" splat {i}")))
    };
    for (i, row) in splats.rows.chunks_exact(SPLAT_STRIDE).enumerate() {
        if let Some((what, v)) = not_finite(row) {
            return refuse(i, what, v);
        }
    }
    if let Some(at) = splats.sh.iter().position(|v| !v.is_finite()) {
        let parent = at / (3 * splats.sh_coefficients());
        return refuse(parent * splats.children_per_parent(), "SH coefficient", splats.sh[at]);
    }
    if let Some(at) = splats.gain.iter().position(|v| !v.is_finite()) {
        return refuse(at / splats.gain_channels().max(1), "gain", splats.gain[at]);
    }
    Ok(())
}

/// Returns `N` bytes at `at`.
pub(super) fn array<const N: usize>(bytes: &[u8], at: usize, path: &Path) -> Result<[u8; N]> {
    at.checked_add(N)
        .and_then(|end| bytes.get(at..end))
        .and_then(|s| <[u8; N]>::try_from(s).ok())
        .ok_or_else(|| truncated(path, at.saturating_add(N) as u64, bytes.len() as u64))
}

/// Returns the little-endian u32 at `at`.
pub(super) fn u32_at(bytes: &[u8], at: usize, path: &Path) -> Result<u32> {
    Ok(u32::from_le_bytes(array(bytes, at, path)?))
}

/// Returns the little-endian f32 at `at`.
pub(super) fn f32_at(bytes: &[u8], at: usize, path: &Path) -> Result<f32> {
    Ok(f32::from_le_bytes(array(bytes, at, path)?))
}

/// Makes the error for a truncated file.
pub(super) fn truncated(path: &Path, expected: u64, got: u64) -> Error {
    Error::format(
        path,
        format!("at least {expected} bytes"),
        format!("{got}: the file is cut short"),
    )
}
