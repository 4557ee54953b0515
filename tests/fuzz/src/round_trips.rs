//! Round trips: what a writer writes, its reader reads back. Bytes become Gaussians and cameras through [`arbitrary`].

use super::Folder;
use arbitrary::{Result, Unstructured};
use glam::{DQuat, Mat4, Quat, Vec3, Vec4};
use subsplat::files::poses::cameras_json::{
    CameraFile, NamedCamera, load_cameras_json, save_cameras_json,
};
use subsplat::files::poses::colmap::save_colmap;
use subsplat::files::poses::scene::load_cameras;
use subsplat::files::splats::spz::SpzVersion;
use subsplat::files::{SaveOptions, SplatFormat, encode_splats, parse_splats};
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::{ShBasis, sh_coefficients};

/// Most Gaussians of a round trip.
const COUNT_MAX: usize = 24;
/// Distance of the first Gaussians' x, units: a file may have another order, and x restores this one.
const STEP_X: f32 = 4.0;

/// Largest differences between a Gaussian and its copy.
struct Allowed {
    /// Of a coordinate `v` of the means, world units.
    mean: Box<dyn Fn(f32) -> f64>,
    /// Of ln σ.
    log_scale: f64,
    opacity: f64,
    /// Of 1 − |q·q'|.
    rotation: f64,
    /// Of SH coefficients of degree 0 and above: absolute, and a factor of the coefficient.
    sh: [f64; 2],
    sh_relative: f64,
}

/// `.ply` and `.glb` hold floats: means and SH are equal, logarithms and unit quaternions are rounded once. The
/// numbers have any magnitude.
pub fn exact(bytes: &[u8]) {
    let Ok(splats) = gaussians(&mut Unstructured::new(bytes), Magnitude::Any) else { return };
    for format in [SplatFormat::Ply, SplatFormat::Glb] {
        let allowed = Allowed {
            mean: Box::new(|_| 0.0),
            log_scale: 1e-5,
            opacity: 1e-6,
            rotation: 1e-6,
            sh: [0.0; 2],
            sh_relative: 1e-6,
        };
        check(&splats, format, SpzVersion::V3, &allowed);
    }
}

/// `.spz`, `.sog` and `.splat` quantise: each number is within the step of its format.
pub fn packed(bytes: &[u8]) {
    let Ok(splats) = gaussians(&mut Unstructured::new(bytes), Magnitude::Scene) else { return };
    let reach = splats.means().flatten().fold(0f32, |m, v| m.max(v.abs()));
    let spz = |version| {
        // 24 bits with sign, at most 20 of them behind the point; half a step and the float's rounding.
        let step = 0.5 * (f64::from(reach) * 2.0 / 8_388_607.0).max(2f64.powi(-20));
        let allowed = Allowed {
            mean: Box::new(move |v| step + 1e-6 * f64::from(v.abs())),
            log_scale: 0.5 / 16.0 + 1e-4,
            opacity: 0.5 / 255.0 + 1e-5,
            rotation: 2e-5,
            sh: [0.5 / (255.0 * 0.15) + 1e-4, 0.5 / 128.0 + 1e-4],
            sh_relative: 1e-5,
        };
        check(&splats, SplatFormat::Spz, version, &allowed);
    };
    spz(SpzVersion::V3);
    spz(SpzVersion::V4);
    let splat = Allowed {
        mean: Box::new(|_| 0.0),
        log_scale: 1e-6,
        opacity: 0.5 / 255.0 + 1e-5,
        rotation: 5e-4,
        sh: [0.5 / 255.0 / 0.282 + 1e-4, 0.0],
        sh_relative: 1e-5,
    };
    check(&splats, SplatFormat::Splat, SpzVersion::V3, &splat);
    // 16 bits of sign(x)·ln(|x| + 1) between the least and the greatest of an axis; 256 values of scales and of SH.
    let step = f64::from(reach).ln_1p() * 2.0 / 65_535.0;
    let sog = Allowed {
        mean: Box::new(move |v| 0.52 * step * (f64::from(v.abs()) + 1.0) + 1e-5),
        log_scale: 0.1,
        opacity: 0.5 / 255.0 + 1e-5,
        rotation: 2e-4,
        sh: [0.02, 0.05],
        sh_relative: 1e-5,
    };
    check(&splats, SplatFormat::Sog, SpzVersion::V3, &sog);
}

/// Cameras through `cameras.json` and through COLMAP's text.
pub fn cameras(bytes: &[u8]) {
    let mut source = Unstructured::new(bytes);
    let mut all = Vec::new();
    while all.len() < 12 && !source.is_empty() {
        let Ok(Some(camera)) = camera(&mut source) else { break };
        all.push((format!("images/{:03}.png", all.len()), camera));
    }
    if all.is_empty() {
        return;
    }
    let folder = Folder::new();
    let named = all.iter().map(|(name, camera)| NamedCamera::new(name.as_str(), *camera)).collect();
    let path = folder.path().join("cameras.json");
    save_cameras_json(&path, &CameraFile { cameras: named, ..Default::default() }).unwrap();
    let read = load_cameras_json(&path).unwrap();
    let back: Vec<Camera> = read.cameras.iter().map(|c| c.camera).collect();
    same_cameras(&all, &back, read.origin.as_vec3());
    let model = folder.path().join("model");
    save_colmap(&model, &all, &[]).unwrap();
    let scene = load_cameras(&model).unwrap();
    let back: Vec<Camera> = scene.frames.iter().map(|f| f.camera).collect();
    same_cameras(&all, &back, scene.origin.as_vec3());
}

/// Range of the numbers of made-up Gaussians.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Magnitude {
    /// Any finite number; σ in [1e-12, 1e30].
    Any,
    /// What the packed formats hold: means within 100, ln σ in [−9.9, 5.4], SH within 0.9.
    Scene,
}

/// A number in [0, 1].
fn unit(source: &mut Unstructured<'_>) -> Result<f32> {
    Ok(f32::from(source.arbitrary::<u16>()?) / f32::from(u16::MAX))
}

fn within(source: &mut Unstructured<'_>, low: f32, high: f32) -> Result<f32> {
    Ok(low + (high - low) * unit(source)?)
}

/// A finite number of any magnitude.
fn finite(source: &mut Unstructured<'_>) -> Result<f32> {
    let v = f32::from_bits(source.arbitrary()?);
    Ok(if v.is_finite() { v } else { 1.0 })
}

/// A unit quaternion, wxyz.
fn rotation(source: &mut Unstructured<'_>) -> Result<[f32; 4]> {
    let [w, x, y, z] = [
        within(source, -1.0, 1.0)?,
        within(source, -1.0, 1.0)?,
        within(source, -1.0, 1.0)?,
        within(source, -1.0, 1.0)?,
    ];
    let q = Vec4::new(w, x, y, z);
    Ok(if q.length() < 0.05 { [1.0, 0.0, 0.0, 0.0] } else { q.normalize().to_array() })
}

fn gaussians(source: &mut Unstructured<'_>, magnitude: Magnitude) -> Result<Splats> {
    let degree = usize::from(source.arbitrary::<u8>()? % 4);
    let count = usize::from(source.arbitrary::<u8>()?) % COUNT_MAX + 1;
    let any = magnitude == Magnitude::Any;
    let number = |source: &mut Unstructured<'_>, reach: f32| {
        if any { finite(source) } else { within(source, -reach, reach) }
    };
    let (mut rows, mut sh) = (Vec::new(), Vec::new());
    for i in 0..count {
        let x = (i as f32 - 12.0) * STEP_X + within(source, 0.0, 0.5)?;
        rows.extend([x, number(source, 100.0)?, number(source, 100.0)?]);
        rows.extend(rotation(source)?);
        for _ in 0..3 {
            let (low, high) = if any { (1e-12f32.ln(), 1e30f32.ln()) } else { (-9.9, 5.4) };
            rows.push(within(source, low, high)?.exp());
        }
        rows.push(unit(source)?);
        for _ in 0..3 * sh_coefficients(degree) {
            sh.push(number(source, 0.9)?);
        }
    }
    Ok(Splats::new(rows, sh, Vec::new(), degree, ShBasis::Standard).unwrap())
}

fn check(before: &Splats, format: SplatFormat, spz_version: SpzVersion, allowed: &Allowed) {
    let options = SaveOptions { spz_version, ..SaveOptions::default() };
    let bytes = match encode_splats(format, before, &options) {
        Ok(bytes) => bytes,
        // An overflow of the colour or of the mean is refused by name.
        Err(error) => return assert!(error.to_string().contains("expected"), "{error}"),
    };
    let name = format!("a.{}", format!("{format:?}").to_lowercase());
    let (after, _) = parse_splats(&bytes, &name).unwrap();
    assert_eq!(after.len(), before.len(), "{format:?}");
    let mut order: Vec<usize> = (0..after.len()).collect();
    order.sort_by(|a, b| after.mean(*a)[0].total_cmp(&after.mean(*b)[0]));
    for (i, j) in order.into_iter().enumerate() {
        same_gaussian(before, i, &after, j, format, allowed);
    }
}

fn same_gaussian(
    a: &Splats,
    i: usize,
    b: &Splats,
    j: usize,
    format: SplatFormat,
    allowed: &Allowed,
) {
    let close = |what: &str, x: f32, y: f32, limit: f64| {
        let off = (f64::from(x) - f64::from(y)).abs();
        assert!(off <= limit, "{format:?}: {what} of {i}: {x} became {y}, off by {off} of {limit}");
    };
    for (x, y) in a.mean(i).into_iter().zip(b.mean(j)) {
        close("mean", x, y, (allowed.mean)(x));
    }
    for (x, y) in a.scale(i).into_iter().zip(b.scale(j)) {
        close("ln of a scale", x.ln(), y.ln(), allowed.log_scale);
    }
    close("opacity", a.opacity(i), b.opacity(j), allowed.opacity);
    let q = |[w, x, y, z]: [f32; 4]| DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into());
    let turned = 1.0 - q(a.quat_wxyz(i)).dot(q(b.quat_wxyz(j))).abs();
    assert!(turned <= allowed.rotation, "{format:?}: rotation of {i}: off by {turned}");
    for (k, (x, y)) in a.sh_of(i).iter().zip(b.sh_of(j)).enumerate() {
        let limit = allowed.sh[usize::from(k >= 3)] + allowed.sh_relative * f64::from(x.abs());
        close("SH", *x, *y, limit);
    }
}

fn camera(source: &mut Unstructured<'_>) -> Result<Option<Camera>> {
    let side =
        |source: &mut Unstructured<'_>| Ok(usize::from(source.arbitrary::<u16>()?) % 4096 + 1);
    let (width, height) = (side(source)?, side(source)?);
    let intrinsics = Intrinsics {
        fx: within(source, 0.0, 14.0)?.exp(),
        fy: within(source, 0.0, 14.0)?.exp(),
        cx: within(source, -4096.0, 4096.0)?,
        cy: within(source, -4096.0, 4096.0)?,
        width,
        height,
    };
    let [w, x, y, z] = rotation(source)?;
    let at = Vec3::new(
        within(source, -1e3, 1e3)?,
        within(source, -1e3, 1e3)?,
        within(source, -1e3, 1e3)?,
    );
    let pose = Mat4::from_rotation_translation(Quat::from_xyzw(x, y, z, w), at);
    Ok(Camera::new(intrinsics, pose).ok())
}

fn same_cameras(before: &[(String, Camera)], after: &[Camera], origin: Vec3) {
    assert_eq!(before.len(), after.len());
    for ((name, a), b) in before.iter().zip(after) {
        let (j, k) = (a.intrinsics(), b.intrinsics());
        assert_eq!((j.width, j.height), (k.width, k.height), "{name}");
        for (x, y) in [(j.fx, k.fx), (j.fy, k.fy), (j.cx, k.cx), (j.cy, k.cy)] {
            assert!((x - y).abs() <= 1e-6 * x.abs().max(1.0), "{name}: {j:?} became {k:?}");
        }
        let (p, q) = (a.world_from_camera(), b.world_from_camera());
        let off = a.position().distance(b.position() + origin);
        // COLMAP stores the translation of the inverse, in floats.
        assert!(
            off <= 1e-5 * a.position().length().max(1.0),
            "{name}: {p} became {q}, off by {off}"
        );
        let off = (a.rotation() - b.rotation())
            .to_cols_array()
            .into_iter()
            .fold(0f32, |m, v| m.max(v.abs()));
        assert!(off <= 1e-5, "{name}: {p} became {q}");
    }
}
