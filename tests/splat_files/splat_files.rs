//! Splat files written by us and by others: every round trip, every fixture.

use subsplat_test_support::edit::Edit;
use subsplat_test_support::splat_scene;

use glam::{DMat3, DVec3};
use splat_scene::*;
use std::path::{Path, PathBuf};
use subsplat::files::{SaveOptions, SplatFormat, Up, load_splats, save_splats, splat_info};
use subsplat::scene::splats::{SplatParts, Splats};
use subsplat_kernels::layout::{SPLAT_STRIDE, ShBasis};

fn save(name: &str, splats: &Splats, options: &SaveOptions) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    save_splats(&path, splats, options).unwrap();
    (folder, path)
}

fn reload(name: &str, splats: &Splats, options: &SaveOptions) -> Splats {
    let (_folder, path) = save(name, splats, options);
    load_splats(&path).unwrap()
}

fn kinds() -> Vec<Kind> {
    let mut kinds = Vec::new();
    for basis in [ShBasis::Standard, ShBasis::Mvsplat] {
        for degree in 0..=4 {
            for (children, gain_channels) in [(1, 0), (4, 1), (9, 4)] {
                kinds.push(Kind { parents: 23, children, degree, gain_channels, basis });
            }
        }
    }
    kinds
}

/// Names of the buffer and of the splat are part of every error.
#[test]
fn numbers_that_are_not_finite_are_refused_by_name() {
    let kind =
        Kind { parents: 9, children: 4, degree: 1, gain_channels: 4, basis: ShBasis::Standard };
    let good = scene(3, kind).into_parts();
    assert!(Splats::try_from(good.clone()).is_ok());
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let refused = |change: &dyn Fn(&mut SplatParts), what: &str, splat: usize| {
            let mut parts = good.clone();
            change(&mut parts);
            let e = Splats::try_from(parts).unwrap_err();
            let expected =
                format!("splats {what}: expected finite numbers, got {bad} at splat {splat}");
            assert_eq!(e.to_string(), expected);
        };
        for offset in 0..SPLAT_STRIDE {
            refused(&|p| p.rows[7 * SPLAT_STRIDE + offset] = bad, "rows", 7);
        }
        // Four coefficients of three channels per parent; the first child of parent 5 is 20.
        refused(&|p| p.sh[5 * 12] = bad, "SH coefficients", 20);
        refused(&|p| p.sh[5 * 12 + 11] = bad, "SH coefficients", 20);
        refused(&|p| p.gain[4 * 11 + 3] = bad, "gain", 11);
        // The first of two is named.
        let two = |p: &mut SplatParts| (p.rows[30 * SPLAT_STRIDE], p.rows[8]) = (bad, bad);
        refused(&two, "rows", 0);
    }
    // One gain per splat, and more rows than one task of the parallel check holds.
    let one = SplatParts { gain: vec![1.0; 36], ..good.clone() };
    let mut parts = one.clone();
    parts.gain[35] = f32::NAN;
    let e = Splats::try_from(parts).unwrap_err().to_string();
    assert!(e.contains("gain") && e.contains("splat 35"), "{e}");
    let mut rows = good.rows[..SPLAT_STRIDE].repeat(20_000);
    rows[19_998 * SPLAT_STRIDE + 4] = f32::INFINITY;
    rows[19_999 * SPLAT_STRIDE] = f32::NAN;
    let e = Splats::new(rows, vec![0.0; 3], Vec::new(), 0, ShBasis::Standard).unwrap_err();
    assert!(e.to_string().contains("rows") && e.to_string().contains("splat 19998"), "{e}");
    // The largest finite numbers and zeros are accepted.
    let mut parts = one;
    parts.rows[..SPLAT_STRIDE].fill(f32::MAX);
    parts.rows[SPLAT_STRIDE..2 * SPLAT_STRIDE].fill(0.0);
    assert!(Splats::try_from(parts).is_ok());
}

/// Degree that a file of at most `limit` keeps, as `splat_scene::colour` counts it.
fn kept(kind: Kind, limit: usize) -> usize {
    kind.degree.min(limit)
}

#[test]
fn ply_and_glb_round_trips_are_exact() {
    for (seed, kind) in kinds().into_iter().enumerate() {
        let before = scene(seed as u64, kind);
        for name in ["a.ply", "a.glb"] {
            let after = reload(name, &before, &SaveOptions::default());
            assert_eq!(after.sh_degree(), kept(kind, 3), "{name} {kind:?}");
            let order = in_order(&before);
            assert_same(&before, &after, &order, DMat3::IDENTITY, kept(kind, 3), EXACT);
        }
        let all = SaveOptions { sh_degree: Some(4), ..Default::default() };
        let after = reload("a.ply", &before, &all);
        // MVSplat's basis ends at degree 3; the reader drops the zeros of the fourth.
        let degree = match kind.basis {
            ShBasis::Standard => kind.degree,
            ShBasis::Mvsplat => kept(kind, 3),
        };
        assert_eq!(after.sh_degree(), degree);
        assert_same(&before, &after, &in_order(&before), DMat3::IDENTITY, degree, EXACT);
    }
}

/// Number of `f_rest` properties of a .ply.
fn rests(path: &Path) -> usize {
    let bytes = std::fs::read(path).unwrap();
    bytes.windows(22).filter(|w| w.starts_with(b"property float f_rest_")).count()
}

#[test]
fn plys_hold_45_rests_unless_a_degree_is_asked_for() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("a.ply");
    for (degree, asked, expected) in [
        (0, None, 45),
        (1, None, 45),
        (3, None, 45),
        (4, None, 45),
        (4, Some(4), 72),
        (1, Some(3), 45),
        (1, Some(4), 45),
        (2, Some(1), 9),
        (2, Some(0), 0),
    ] {
        let kind =
            Kind { parents: 9, children: 1, degree, gain_channels: 0, basis: ShBasis::Standard };
        let before = scene(degree as u64, kind);
        let options = SaveOptions { sh_degree: asked, ..Default::default() };
        save_splats(&path, &before, &options).unwrap();
        assert_eq!(rests(&path), expected, "degree {degree}, asked {asked:?}");
        // The padding is dropped again.
        let after = load_splats(&path).unwrap();
        assert_eq!(after.sh_degree(), degree.min(asked.unwrap_or(3)));
    }
    // A degree that the last Gaussian alone uses: the ones before get zeros.
    let mut sh = vec![0.0; 3 * 48];
    sh[2 * 48 + 3 * 5 + 1] = 0.25;
    let rows = [[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5]; 3].concat();
    let late = Splats::new(rows, sh, Vec::new(), 3, ShBasis::Standard).unwrap();
    save_splats(&path, &late, &SaveOptions::default()).unwrap();
    let after = load_splats(&path).unwrap();
    assert_eq!(after.sh_degree(), 2);
    for i in 0..3 {
        assert_eq!(after.sh_of(i), &late.sh_of(i)[..27]);
    }
}

#[test]
fn standard_coefficients_pass_a_ply_bit_by_bit() {
    let kind =
        Kind { parents: 300, children: 1, degree: 3, gain_channels: 0, basis: ShBasis::Standard };
    let before = scene(5, kind);
    let after = reload("a.ply", &before, &SaveOptions::default());
    assert_eq!(before.sh(), after.sh());
    let again = reload("b.ply", &after, &SaveOptions::default());
    assert_eq!(after.sh(), again.sh());
}

#[test]
fn lower_degrees_are_cut_after_the_change_of_basis() {
    let kind =
        Kind { parents: 40, children: 4, degree: 3, gain_channels: 4, basis: ShBasis::Mvsplat };
    let before = scene(6, kind);
    let full = reload("a.ply", &before, &SaveOptions::default());
    for degree in 0..3 {
        let options = SaveOptions { sh_degree: Some(degree), ..Default::default() };
        let cut = reload("a.ply", &before, &options);
        assert_eq!(cut.sh_degree(), degree);
        let d = (degree + 1) * (degree + 1);
        for i in 0..cut.len() {
            assert_eq!(cut.sh_of(i), &full.sh_of(i)[..3 * d], "splat {i} degree {degree}");
        }
    }
}

/// Field by field at computed offsets: an independent reading of the one layout.
#[test]
fn ply_layout_is_inrias() {
    let kind =
        Kind { parents: 7, children: 2, degree: 3, gain_channels: 4, basis: ShBasis::Standard };
    let s = scene(7, kind);
    let comments = vec!["two\nlines".to_owned()];
    let (_folder, path) = save("a.ply", &s, &SaveOptions { comments, ..Default::default() });
    let bytes = std::fs::read(path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let lines: Vec<&str> = header.lines().collect();
    assert_eq!(lines[..2], ["ply", "format binary_little_endian 1.0"]);
    assert_eq!(lines.iter().filter(|l| l.starts_with("element")).count(), 1);
    assert!(lines.contains(&"element vertex 14"));
    for comment in
        ["comment subsplat", "comment units", "comment axes: +x right, +y down", "comment lines"]
    {
        assert!(lines.iter().any(|l| l.starts_with(comment)), "{comment} in {header}");
    }
    let mut expected = vec!["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        .into_iter()
        .map(str::to_owned)
        .collect::<Vec<_>>();
    expected.extend((0..45).map(|i| format!("f_rest_{i}")));
    for name in ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"] {
        expected.push(name.to_owned());
    }
    let got: Vec<String> =
        lines.iter().filter_map(|l| l.strip_prefix("property float ")).map(str::to_owned).collect();
    assert_eq!(got, expected);
    assert_eq!(bytes.len(), end + 14 * 62 * 4);
    for i in 0..14 {
        let f = |k: usize| {
            let at = end + (62 * i + k) * 4;
            f64::from(f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()))
        };
        let close = |k: usize, v: f64| {
            assert!((f(k) - v).abs() < 1e-5 * (1.0 + v.abs()), "{i} {}: {} {v}", expected[k], f(k));
        };
        let (gamma, delta) = s.gain_of(i);
        let h = s.sh_of(i);
        for c in 0..3 {
            assert_eq!(f(c) as f32, s.mean(i)[c]);
            assert_eq!(f(3 + c), 0.0);
            let dc = f64::from(gamma * h[c]) + f64::from(delta[c]) / 0.282_094_791_773_878_14;
            close(6 + c, dc);
            for j in 1..16 {
                close(9 + 15 * c + j - 1, f64::from(gamma * h[3 * j + c]));
            }
            close(55 + c, f64::from(s.scale(i)[c]).ln());
        }
        let a = f64::from(s.opacity(i));
        close(54, (a / (1.0 - a)).ln());
        let q = s.quat_wxyz(i).map(f64::from);
        let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
        (0..4).for_each(|k| close(58 + k, q[k] / norm));
    }
}

#[test]
fn up_axes_turn_means_shapes_and_colours_together() {
    let y = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    // Columns: where our right, down and forward go when z is up and y is forward.
    let z = DMat3::from_cols(DVec3::X, DVec3::new(0.0, 0.0, -1.0), DVec3::Y);
    for (seed, kind) in kinds().into_iter().enumerate() {
        let before = scene(100 + seed as u64, kind);
        let order = in_order(&before);
        for (up, turn) in [(Up::Keep, DMat3::IDENTITY), (Up::Y, y), (Up::Z, z)] {
            let options = SaveOptions { up, ..Default::default() };
            let degree = kept(kind, 3);
            let after = reload("a.ply", &before, &options);
            assert_same(&before, &after, &order, turn, degree, EXACT);
            // A .glb defines the up axis: the reader rotates it back.
            let after = reload("a.glb", &before, &options);
            assert_same(&before, &after, &order, DMat3::IDENTITY, degree, EXACT);
        }
    }
    assert_eq!("z".parse::<Up>(), Ok(Up::Z));
    assert!("x".parse::<Up>().unwrap_err().contains("keep, y or z"));
}

/// Half a quantisation step of each .spz field, with a margin for rounding.
const SPZ: Tolerance = Tolerance {
    mean: 0.51 / (1u32 << 20) as f64 + 1e-6,
    // ln σ to 1/32: σ² to 6.5 %; rotation to 1/700.
    covariance: 0.075,
    opacity: 0.51 / 255.0,
    // Degree 0 to C₀·½/255/0.15; 15 coefficients to 1/256 each, times Σ|Y| ≤ 4.23.
    colour: 0.0205,
};

#[test]
fn spz_round_trips_within_its_steps() {
    for (seed, mut kind) in kinds().into_iter().enumerate() {
        kind.degree = kind.degree.min(3);
        let mut before = scene(200 + seed as u64, kind);
        // Gains and the change of basis may carry ±0.4 beyond ±1, which .spz clamps.
        before.edit(|p| p.sh.iter_mut().for_each(|h| *h *= 0.6));
        for up in [Up::Keep, Up::Y] {
            let options = SaveOptions { up, ..Default::default() };
            let after = reload("a.spz", &before, &options);
            assert_eq!(after.sh_degree(), kind.degree);
            assert_same(&before, &after, &in_order(&before), DMat3::IDENTITY, kind.degree, SPZ);
            // Quantised values stay the same.
            let again = reload("b.spz", &after, &options);
            assert_eq!(after.sh(), again.sh());
            assert_eq!(
                after.rows().chunks(SPLAT_STRIDE).map(|r| &r[..3]).collect::<Vec<_>>(),
                again.rows().chunks(SPLAT_STRIDE).map(|r| &r[..3]).collect::<Vec<_>>()
            );
        }
        let z = SaveOptions { up: Up::Z, ..Default::default() };
        let folder = tempfile::tempdir().unwrap();
        let refused = save_splats(folder.path().join("a.spz"), &before, &z).unwrap_err();
        assert!(refused.to_string().contains("y-up by definition"), "{refused}");
    }
}

#[test]
fn splat_round_trips_sorted_at_degree_zero() {
    for (seed, kind) in kinds().into_iter().enumerate() {
        let before = scene(300 + seed as u64, kind);
        let after = reload("a.splat", &before, &SaveOptions::default());
        let weight = |i: usize| {
            let volume: f64 = before.scale(i).iter().map(|v| f64::from(*v)).product();
            volume * f64::from(before.opacity(i))
        };
        let mut order = in_order(&before);
        order.sort_by(|&a, &b| weight(b).total_cmp(&weight(a)));
        // The colour of degree 0 of the standard basis, clamped to a picture's range.
        let options = SaveOptions { sh_degree: Some(0), ..Default::default() };
        let flat = reload("a.ply", &before, &options);
        let allowed = Tolerance {
            mean: 0.0,
            // Quaternion bytes of 1/128.
            covariance: 0.04,
            opacity: 0.51 / 255.0,
            colour: 0.51 / 255.0,
        };
        assert_same(&flat, &after, &order, DMat3::IDENTITY, 0, allowed);
    }
}

/// Viewers do not normalise these bytes: a quaternion along an axis keeps its length.
#[test]
fn splat_quaternion_bytes_reach_their_ends() {
    let kind =
        Kind { parents: 4, children: 1, degree: 0, gain_channels: 0, basis: ShBasis::Standard };
    let mut s = scene(16, kind);
    s.edit(|p| {
        for (i, row) in p.rows.chunks_exact_mut(SPLAT_STRIDE).enumerate() {
            row[3..7].fill(0.0);
            row[3 + i] = if i % 2 == 0 { 3.0 } else { -0.5 };
            row[7..].fill(1.0 / (1.0 + i as f32));
        }
    });
    let (_folder, path) = save("a.splat", &s, &SaveOptions::default());
    for (i, record) in std::fs::read(path).unwrap().chunks_exact(32).enumerate() {
        let mut expected = [128; 4];
        expected[i] = 0;
        assert_eq!(record[28..], expected);
    }
}

#[test]
fn opacities_and_scales_at_their_ends_stay_finite() {
    let opacities = [0.0, 1e-9, 1e-7, 1e-4, 0.5, 0.999, 1.0 - 1e-6, 1.0, 1.000_01, -0.000_01];
    let mut rows = Vec::new();
    for (i, a) in opacities.into_iter().enumerate() {
        let scale = if i == 0 { [0.0, -1.0, 2.0] } else { [0.1, 0.2, 0.3] };
        rows.extend([i as f32, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
        rows.extend(scale);
        rows.push(a);
    }
    let n = opacities.len();
    let s = Splats::new(rows, vec![0.1; 3 * n], Vec::new(), 0, ShBasis::Standard).unwrap();
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.ply", "a.glb", "a.spz", "a.splat"] {
        let path = folder.path().join(name);
        let report = save_splats(&path, &s, &SaveOptions::default()).unwrap();
        assert_eq!((report.count, report.clamped_scales), (n, 1));
        assert_eq!(report.bytes, std::fs::metadata(&path).unwrap().len());
        let back = load_splats(&path).unwrap();
        if name == "a.ply" || name == "a.glb" {
            for (i, a) in opacities.into_iter().enumerate() {
                let off = (back.opacity(i) - a.clamp(0.0, 1.0)).abs();
                assert!(off <= 1e-6, "{name}: opacity {a} became {}", back.opacity(i));
            }
            assert!(back.scale(0)[0] > 0.0 && back.scale(0)[1] < 1e-11);
        }
    }
}

#[test]
fn pruning_counts_and_an_empty_result_is_refused() {
    let kind =
        Kind { parents: 50, children: 4, degree: 1, gain_channels: 1, basis: ShBasis::Standard };
    let s = scene(8, kind);
    let folder = tempfile::tempdir().unwrap();
    let order: Vec<usize> = (0..s.len()).filter(|&i| s.opacity(i) >= 0.4).collect();
    for name in ["a.ply", "a.glb"] {
        let path = folder.path().join(name);
        let options = SaveOptions { min_opacity: 0.4, ..Default::default() };
        let report = save_splats(&path, &s, &options).unwrap();
        assert_eq!((report.count, report.pruned), (order.len(), s.len() - order.len()));
        assert!(report.pruned > 20);
        let back = load_splats(&path).unwrap();
        assert_same(&s, &back, &order, DMat3::IDENTITY, 1, EXACT);
        let options = SaveOptions { min_opacity: 1.0, ..Default::default() };
        let refused = save_splats(&path, &s, &options).unwrap_err().to_string();
        assert!(refused.contains("at least one Gaussian"), "{refused}");
    }
    for bad in [f32::NAN, -0.1, 1.5] {
        let options = SaveOptions { min_opacity: bad, ..Default::default() };
        assert!(save_splats(folder.path().join("b.ply"), &s, &options).is_err());
    }
}

#[test]
fn numbers_that_are_not_finite_are_refused_by_index() {
    let kind =
        Kind { parents: 5, children: 2, degree: 1, gain_channels: 4, basis: ShBasis::Standard };
    let good = scene(9, kind);
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.ply", "a.glb", "a.spz", "a.splat"] {
        let path = folder.path().join(name);
        let refused = |s: &Splats, place: &str, what: &str| {
            let e = save_splats(&path, s, &SaveOptions::default()).unwrap_err().to_string();
            assert!(e.contains(place) && e.contains(what) && e.contains(name), "{e}");
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "{e}");
        };
        for (lane, what) in [(1, "mean"), (5, "quaternion"), (8, "scale"), (10, "opacity")] {
            for value in [f32::NAN, f32::INFINITY] {
                let mut s = good.clone();
                s.edit(|p| p.rows[7 * SPLAT_STRIDE + lane] = value);
                refused(&s, "splat 7", what);
            }
        }
        let mut s = good.clone();
        s.edit(|p| p.sh[12 * 3 + 4] = f32::NAN); // the fourth parent's, whose first child is 6
        refused(&s, "splat 6", "SH");
        let mut s = good.clone();
        s.edit(|p| p.gain[4 * 9 + 2] = f32::INFINITY);
        refused(&s, "splat 9", "gain");
        let mut s = good.clone();
        s.edit(|p| p.rows[3 * SPLAT_STRIDE + 10] = 1.5);
        refused(&s, "splat 3", "opacity in [0, 1]");
        let mut s = good.clone();
        s.edit(|p| (p.gain[4 * 4], p.sh[2 * 12]) = (3e38, 3e38));
        refused(&s, "splat 4", "overflow");
    }
}

#[test]
fn names_and_magics_choose_the_format() {
    let kind =
        Kind { parents: 3, children: 1, degree: 0, gain_channels: 0, basis: ShBasis::Standard };
    let s = scene(10, kind);
    let folder = tempfile::tempdir().unwrap();
    for (name, format) in [
        ("a.PLY", SplatFormat::Ply),
        ("a.Glb", SplatFormat::Glb),
        ("a.spz", SplatFormat::Spz),
        ("a.sog", SplatFormat::Sog),
        ("a.splat", SplatFormat::Splat),
    ] {
        let path = folder.path().join(name);
        assert_eq!(save_splats(&path, &s, &SaveOptions::default()).unwrap().format, format);
        assert_eq!(splat_info(&path).unwrap().format, format);
        if format != SplatFormat::Splat {
            // The content wins over a wrong name.
            let other = folder.path().join("renamed.splat");
            std::fs::copy(&path, &other).unwrap();
            assert_eq!(splat_info(&other).unwrap().format, format);
            assert_eq!(load_splats(&other).unwrap().len(), 3);
        }
    }
    for name in ["a.ksplat", "a.compressed.ply", "meta.json", "a"] {
        let e = save_splats(folder.path().join(name), &s, &SaveOptions::default()).unwrap_err();
        assert!(e.to_string().contains(".ply, .glb, .spz, .sog or .splat"), "{e}");
    }
    std::fs::write(folder.path().join("a.zip"), b"PK\x03\x04rest").unwrap();
    let e = load_splats(folder.path().join("a.zip")).unwrap_err().to_string();
    assert!(e.contains("a whole zip archive (.sog)"), "{e}");
}

#[test]
fn info_describes_what_is_there() {
    let kind =
        Kind { parents: 101, children: 1, degree: 2, gain_channels: 0, basis: ShBasis::Standard };
    let mut s = scene(11, kind);
    s.edit(|p| {
        (0..101).for_each(|i| p.rows[i * SPLAT_STRIDE + 10] = i as f32 / 100.0);
    });
    let (folder, path) = save("a.ply", &s, &SaveOptions::default());
    let info = splat_info(&path).unwrap();
    assert_eq!((info.count, info.sh_degree, info.non_finite, info.invisible), (101, 2, 0, 1));
    assert_eq!(info.flavour, "ply binary_little_endian");
    assert!(info.comments.iter().any(|c| c.starts_with("subsplat ")), "{:?}", info.comments);
    let [low, high] = info.bounds.unwrap();
    for (axis, (low, high)) in low.into_iter().zip(high).enumerate() {
        let column = || (0..101).map(|i| s.mean(i)[axis]);
        assert_eq!(low, column().fold(f32::INFINITY, f32::min));
        assert_eq!(high, column().fold(f32::NEG_INFINITY, f32::max));
    }
    let expected = [0.0, 0.01, 0.25, 0.5, 0.75, 0.99, 1.0];
    for (got, want) in info.opacity.iter().zip(expected) {
        assert!((got - want).abs() < 1e-6, "{:?}", info.opacity);
    }
    let json = serde_json::to_value(&info).unwrap();
    assert_eq!(json["format"], "ply");
    assert_eq!(json["scale"].as_array().unwrap().len(), 7);

    // A NaN mean and an infinite scale are left out and counted, the first by index.
    let mut bytes = std::fs::read(&path).unwrap();
    let first = bytes.len() - 101 * (17 + 45) * 4;
    for (i, field, v) in [(5, 2, f32::NAN), (9, 9 + 45 + 1, f32::INFINITY)] {
        let at = first + (i * (17 + 45) + field) * 4;
        bytes[at..at + 4].copy_from_slice(&v.to_le_bytes());
    }
    let path = folder.path().join("nan.ply");
    std::fs::write(&path, bytes).unwrap();
    let info = splat_info(&path).unwrap();
    assert_eq!((info.count, info.non_finite, info.zero_rows, info.invisible), (99, 2, 0, 1));
    let [note] = &info.notes[..] else { panic!("{:?}", info.notes) };
    assert!(note.contains("2 of 101 splats") && note.contains("splat 5 (mean NaN)"), "{note}");
    assert_eq!(load_splats(&path).unwrap().len(), 99);
}

/// A .glb parsed by hand: the fields that viewers rely on.
#[test]
fn glb_structure_is_what_gltf_asks_for() {
    let kind = Kind {
        parents: 20_000,
        children: 1,
        degree: 3,
        gain_channels: 0,
        basis: ShBasis::Standard,
    };
    let mut s = scene(12, kind);
    // Mid-grey, fully opaque, at the identity.
    s.edit(|p| {
        let row = [9., 8., 7., 2., 0., 0., 0., 0.1, 0.2, 0.3, 1.0];
        p.rows[..SPLAT_STRIDE].copy_from_slice(&row);
        p.sh[..3].fill(0.0);
    });
    let (_folder, path) = save("a.glb", &s, &SaveOptions::default());
    let bytes = std::fs::read(path).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    let json_length = word(12);
    assert_eq!((json_length % 4, &bytes[16..20]), (0, &b"JSON"[..]));
    let json: serde_json::Value = serde_json::from_slice(&bytes[20..20 + json_length]).unwrap();
    let bin = 20 + json_length;
    assert_eq!((&bytes[bin + 4..bin + 8], word(bin)), (&b"BIN\0"[..], bytes.len() - bin - 8));
    assert_eq!(json["buffers"][0]["byteLength"], word(bin));
    assert_eq!(json["extensionsUsed"][0], "KHR_gaussian_splatting");
    assert_eq!(json["nodes"][0]["rotation"], serde_json::json!([1.0, 0.0, 0.0, 0.0]));
    let primitive = &json["meshes"][0]["primitives"][0];
    assert_eq!(primitive["mode"], 0);
    let extension = &primitive["extensions"]["KHR_gaussian_splatting"];
    for (key, value) in [
        ("kernel", "ellipse"),
        ("colorSpace", "srgb_rec709_display"),
        ("projection", "perspective"),
        ("sortingMethod", "cameraDistance"),
    ] {
        assert_eq!(extension[key], value);
    }
    let attributes = primitive["attributes"].as_object().unwrap();
    assert_eq!(attributes.len(), 4 + 16 + 1);
    let first = |name: &str| {
        let accessor = &json["accessors"][attributes[name].as_u64().unwrap() as usize];
        assert_eq!(accessor["count"], 20_000, "{name}");
        let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let offset = view["byteOffset"].as_u64().unwrap() as usize;
        assert_eq!(offset % 4, 0, "{name}");
        bin + 8 + offset
    };
    let float = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    let rotation = first("KHR_gaussian_splatting:ROTATION");
    assert_eq!([0, 4, 8, 12].map(|o| float(rotation + o)), [0.0, 0.0, 0.0, 1.0]);
    let scale = first("KHR_gaussian_splatting:SCALE");
    assert_eq!([0, 4, 8].map(|o| float(scale + o)), [0.1, 0.2, 0.3]);
    assert_eq!(float(first("KHR_gaussian_splatting:OPACITY")), 1.0);
    // Index l² + n, in the last of the blocks that the writer makes.
    let sh = first("KHR_gaussian_splatting:SH_DEGREE_2_COEF_3") + 19_999 * 12;
    assert_eq!([0, 4, 8].map(|o| float(sh + o)), s.sh_of(19_999)[3 * 7..3 * 8]);
    // ½ on the display is 0.2140 in linear light.
    let colour = first("COLOR_0");
    let short =
        |o: usize| u16::from_le_bytes(bytes[colour + o..colour + o + 2].try_into().unwrap());
    assert_eq!([0, 2, 4, 6].map(short), [14027, 14027, 14027, 65535]);
    let position = &json["accessors"][attributes["POSITION"].as_u64().unwrap() as usize];
    for axis in 0..3 {
        let column = || (0..s.len()).map(|i| s.mean(i)[axis]);
        let (low, high) = (position["min"][axis].as_f64(), position["max"][axis].as_f64());
        assert_eq!(low, Some(f64::from(column().fold(f32::INFINITY, f32::min))));
        assert_eq!(high, Some(f64::from(column().fold(f32::NEG_INFINITY, f32::max))));
    }
}

/// Rewrites the JSON of a .glb.
fn edit_glb(path: &Path, edit: impl FnOnce(&mut serde_json::Value)) {
    let bytes = std::fs::read(path).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let mut json = serde_json::from_slice(&bytes[20..20 + length]).unwrap();
    edit(&mut json);
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut out = bytes[..8].to_vec();
    out.extend(((20 + text.len() + bytes.len() - 20 - length) as u32).to_le_bytes());
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(&bytes[16..20]);
    out.extend(&text);
    out.extend(&bytes[20 + length..]);
    std::fs::write(path, out).unwrap();
}

#[test]
fn glb_nodes_move_turn_and_scale_splats() {
    let kind =
        Kind { parents: 30, children: 1, degree: 3, gain_channels: 0, basis: ShBasis::Standard };
    let s = scene(13, kind);
    let (_folder, path) = save("a.glb", &s, &SaveOptions { up: Up::Y, ..Default::default() });
    // Parent: a quarter turn about z and a shift; child: doubled. Both in glTF's axes.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    edit_glb(&path, |json| {
        json["nodes"] = serde_json::json!([
            { "translation": [1.0, 2.0, 3.0], "rotation": [0.0, 0.0, half, half], "children": [1] },
            { "mesh": 0, "scale": [2.0, 2.0, 2.0] }
        ]);
    });
    let after = load_splats(&path).unwrap();
    // In ours: x to −y, y to x.
    let turn = DMat3::from_cols(DVec3::NEG_Y, DVec3::X, DVec3::Z);
    let mut expected = s.clone();
    expected.edit(|p| {
        for (i, row) in p.rows.chunks_exact_mut(SPLAT_STRIDE).enumerate() {
            let m = s.mean(i);
            // glTF (x, −y, −z), doubled, turned to (−y, x, z), shifted, and back to ours.
            let g = [2.0 * m[0], -2.0 * m[1], -2.0 * m[2]];
            let g = [1.0 - g[1], 2.0 + g[0], 3.0 + g[2]];
            // `assert_same` turns the mean: give it the one before the turn.
            row[..3].copy_from_slice(&[g[1], g[0], -g[2]]);
            row[7..10].iter_mut().for_each(|v| *v *= 2.0);
        }
    });
    let allowed = Tolerance { mean: 4e-6, ..EXACT };
    assert_same(&expected, &after, &in_order(&s), turn, 3, allowed);
    for (node, what) in [
        (serde_json::json!([{ "mesh": 0, "scale": [1.0, 2.0, 1.0] }]), "scale uniformly"),
        (serde_json::json!([{ "mesh": 0, "scale": [-1.0, 1.0, 1.0] }]), "scale uniformly"),
        (serde_json::json!([{ "mesh": 0, "scale": [0.0, 0.0, 0.0] }]), "scale uniformly"),
        (serde_json::json!([{ "children": [1] }, { "mesh": 0, "children": [0] }]), "tree of nodes"),
        (serde_json::json!([{ "mesh": 7 }]), "mesh"),
    ] {
        edit_glb(&path, |json| json["nodes"] = node);
        let e = load_splats(&path).unwrap_err().to_string();
        assert!(e.contains(what), "{e}");
    }
}

#[test]
fn glb_quantised_attributes_are_read() {
    let kind =
        Kind { parents: 16, children: 1, degree: 0, gain_channels: 0, basis: ShBasis::Standard };
    let s = scene(14, kind);
    let (_folder, path) = save("a.glb", &s, &SaveOptions::default());
    // COLOR_0's alpha holds the opacity as normalised shorts: read it through a stride.
    edit_glb(&path, |json| {
        let attributes = json["meshes"][0]["primitives"][0]["attributes"].clone();
        let index = |n: &str| attributes[n].as_u64().unwrap() as usize;
        let opacity = index("KHR_gaussian_splatting:OPACITY");
        let view = json["accessors"][index("COLOR_0")]["bufferView"].clone();
        json["bufferViews"][view.as_u64().unwrap() as usize]["byteStride"] = 8.into();
        json["accessors"][opacity] = serde_json::json!({
            "bufferView": view, "byteOffset": 6, "componentType": 5123, "normalized": true,
            "count": 16, "type": "SCALAR"
        });
    });
    let after = load_splats(&path).unwrap();
    let allowed = Tolerance { opacity: 0.6 / 65535.0, ..EXACT };
    assert_same(&s, &after, &in_order(&s), DMat3::IDENTITY, 0, allowed);
}

/// The Khronos validator over files of every degree. It comes from the npm registry,
/// so it runs with `SUBSPLAT_GLB_CHECK=require` only (CI).
#[test]
fn khronos_validator_accepts_our_glbs() {
    if std::env::var("SUBSPLAT_GLB_CHECK").is_ok_and(|v| v == "require") {
        let folder = tempfile::tempdir().unwrap();
        let mut files = Vec::new();
        for (k, up) in [Up::Keep, Up::Y, Up::Z, Up::Keep].into_iter().enumerate() {
            let basis = ShBasis::Mvsplat;
            let kind = Kind { parents: 30, children: 4, degree: k, gain_channels: 4, basis };
            let path = folder.path().join(format!("degree{k}.glb"));
            let comments = vec!["a comment".to_owned()];
            let options = SaveOptions { up, comments, ..Default::default() };
            save_splats(&path, &scene(15, kind), &options).unwrap();
            files.push(path);
        }
        let run = |files: &[PathBuf]| {
            let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tools/check_glb.mjs");
            std::process::Command::new("node").arg(script).args(files).output().unwrap()
        };
        let good = run(&files);
        let text = |o: &std::process::Output| {
            String::from_utf8_lossy(&[&o.stdout[..], &o.stderr[..]].concat()).into_owned()
        };
        assert_eq!(good.status.code(), Some(0), "{}", text(&good));
        assert!(text(&good).contains("120 splats of degree 3"), "{}", text(&good));
        // It must reject files: for mistakes of the container and of the extension.
        let edits: [fn(&mut serde_json::Value); 4] = [
            |j| j["accessors"][0]["max"][0] = 99.0.into(),
            |j| j["bufferViews"][0]["byteOffset"] = 2.into(),
            |j| j["meshes"][0]["primitives"][0]["mode"] = 4.into(),
            |j| j["accessors"][2]["type"] = "VEC4".into(),
        ];
        for (k, edit) in edits.into_iter().enumerate() {
            let path = folder.path().join(format!("bad{k}.glb"));
            std::fs::copy(&files[0], &path).unwrap();
            edit_glb(&path, edit);
            let bad = run(&[path]);
            assert_eq!(bad.status.code(), Some(1), "edit {k}: {}", text(&bad));
        }
    } else {
        eprintln!("SKIP: SUBSPLAT_GLB_CHECK=require is not set; the validator was not run");
    }
}
