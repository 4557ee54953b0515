//! Splat files that other projects wrote, and every dialect of .ply.

use subsplat_test_support as common;
use subsplat_test_support::splat_scene;

use common::{npy, shared};
use glam::{DMat3, DVec3};
use splat_scene::*;
use std::io::Read;
use subsplat::files::splats::ply::parse_ply;
use subsplat::files::{SaveOptions, load_splats, save_splats, splat_info};
use subsplat::scene::splats::Splats;
use subsplat_kernels::layout::ShBasis;

const C0: f64 = 0.282_094_791_773_878_14;

fn near(what: &str, got: f64, expected: f64, allowed: f64) {
    assert!((got - expected).abs() <= allowed, "{what}: expected {expected}, got {got}");
}

/// The 62 floats of Gaussian `i` of a plain INRIA file, by offset alone.
fn inria_row(bytes: &[u8], i: usize) -> Vec<f64> {
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    bytes[end + 248 * i..end + 248 * (i + 1)]
        .chunks_exact(4)
        .map(|b| f64::from(f32::from_le_bytes(b.try_into().unwrap())))
        .collect()
}

fn assert_is_inria_row(s: &Splats, i: usize, row: &[f64]) {
    let norm = row[58..62].iter().map(|v| v * v).sum::<f64>().sqrt();
    for c in 0..3 {
        assert_eq!(f64::from(s.mean(i)[c]), row[c]);
        near("scale", f64::from(s.scale(i)[c]), row[55 + c].exp(), 1e-6 * row[55 + c].exp());
        assert_eq!(f64::from(s.sh_of(i)[c]), row[6 + c]);
        for j in 1..16 {
            assert_eq!(f64::from(s.sh_of(i)[3 * j + c]), row[9 + 15 * c + j - 1]);
        }
    }
    near("opacity", f64::from(s.opacity(i)), 1.0 / (1.0 + (-row[54]).exp()), 1e-6);
    for k in 0..4 {
        near("quaternion", f64::from(s.quat_wxyz(i)[k]), row[58 + k] / norm, 1e-6);
    }
}

#[test]
fn real_inria_files_are_read_field_by_field_and_survive_a_round_trip() {
    for (name, count) in [
        ("fixtures/splats/metalsplatter_3points.ply", 3),
        ("photos/re10k_5aca87f95a9412c6/5aca87f95a9412c6.globalsplat16k.ply", 16_384),
    ] {
        let Some(path) = shared(name) else { return };
        let bytes = std::fs::read(&path).unwrap();
        let s = load_splats(&path).unwrap();
        assert_eq!((s.len(), s.sh_degree()), (count, 3));
        for i in (0..count).step_by(1 + count / 500) {
            assert_is_inria_row(&s, i, &inria_row(&bytes, i));
        }
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.ply", "a.glb"] {
            let copy = folder.path().join(name);
            save_splats(&copy, &s, &SaveOptions::default()).unwrap();
            let back = load_splats(&copy).unwrap();
            // `EXACT`'s mean is for scenes of a few units.
            let reach = splat_info(&path).unwrap().bounds.unwrap();
            let reach = reach.iter().flatten().fold(1.0f64, |m, v| m.max(f64::from(v.abs())));
            let allowed = Tolerance { mean: 1e-7 * reach, covariance: 1e-5, ..EXACT };
            assert_same(&s, &back, &in_order(&s), DMat3::IDENTITY, 3, allowed);
        }
    }
}

/// The same three Gaussians in three formats, by MetalSplatter.
#[test]
fn the_three_gaussians_agree_across_formats() {
    let name = |e: &str| format!("fixtures/splats/metalsplatter_3points.{e}");
    let (Some(ply), Some(splat), Some(spz)) =
        (shared(&name("ply")), shared(&name("splat")), shared(&name("spz")))
    else {
        return;
    };
    let ply = load_splats(&ply).unwrap();
    let splat = load_splats(&splat).unwrap();
    let spz = load_splats(&spz).unwrap();
    assert_eq!((ply.len(), splat.len(), spz.len()), (3, 3, 3));
    assert_eq!((ply.sh_degree(), splat.sh_degree(), spz.sh_degree()), (3, 0, 3));
    let mut telling = 0;
    for i in 0..3 {
        for c in 0..3 {
            let m = f64::from(ply.mean(i)[c]);
            near(".splat mean", f64::from(splat.mean(i)[c]), m, 1e-6);
            near(".spz mean", f64::from(spz.mean(i)[c]), m, 0.51 / 4096.0);
            let dc = f64::from(ply.sh_of(i)[c]);
            near(".spz dc", f64::from(spz.sh_of(i)[c]), dc, 0.51 / 255.0 / 0.15);
            // Its writer truncates, to 256 steps.
            let shown = (0.5 + C0 * dc).clamp(0.0, 1.0);
            near(".splat colour", 0.5 + C0 * f64::from(splat.sh_of(i)[c]), shown, 1.1 / 255.0);
        }
        let a = f64::from(ply.opacity(i));
        near(".splat opacity", f64::from(splat.opacity(i)), a, 1.1 / 255.0);
        near(".spz opacity", f64::from(spz.opacity(i)), a, 1.1 / 255.0);
        let p = covariance(&ply, i);
        for (what, other, allowed) in [("splat", &splat, 0.05), ("spz", &spz, 0.075)] {
            let trace = p.x_axis.x + p.y_axis.y + p.z_axis.z;
            let off = (p - covariance(other, i)).to_cols_array();
            let off = off.iter().fold(0.0f64, |m, v| m.max(v.abs())) / trace;
            assert!(off < allowed, ".{what} covariance of {i}: off by {off}");
        }
        for j in 1..16 {
            // Niantic's default rounds degree 1 to 5 bits and the rest to 4, not to nearest.
            let allowed = if j < 4 { 8.1 / 128.0 } else { 16.1 / 128.0 };
            for c in 0..3 {
                let h = f64::from(ply.sh_of(i)[3 * j + c]);
                near(".spz SH", f64::from(spz.sh_of(i)[3 * j + c]), h, allowed);
                telling += usize::from(h.abs() > allowed / 2.0 + 1e-3);
            }
        }
    }
    assert!(telling > 0, "no coefficient is large enough to show a wrong sign");
}

/// Four grey-green Gaussians on a square, in every format of splat-transform's tests.
#[test]
fn minimal_files_agree() {
    let load = |e: &str| {
        shared(&format!("fixtures/splats/splattransform_minimal{e}"))
            .map(|p| (load_splats(&p).unwrap(), splat_info(&p).unwrap().flavour))
    };
    let xz = [[-1.0, -1.0], [0.0, -1.0], [-1.0, 0.0], [0.0, 0.0]];
    let bytes = [[85, 85], [170, 85], [85, 170], [170, 170]];
    for (ending, flavour) in [
        (".splat", "splat"),
        (".ksplat", "ksplat 0.1 level 0"),
        ("-v4.spz", "spz 4"),
        ("-v3.spz", "spz 3"),
        ("-v2.spz", "spz 2"),
        ("-raw.spz", "spz 2"),
    ] {
        let Some((s, found)) = load(ending) else { return };
        assert_eq!((s.len(), s.sh_degree(), found.as_str()), (4, 0, flavour));
        // Their version 2 was made without the turn of axes and with RGB bytes as they are.
        let old = flavour == "spz 2";
        for i in 0..4 {
            let z = if old { -xz[i][1] } else { xz[i][1] };
            near("x", f64::from(s.mean(i)[0]), xz[i][0], 1e-6);
            near("y", f64::from(s.mean(i)[1]), 0.0, 1e-6);
            near("z", f64::from(s.mean(i)[2]), z, 1e-6);
            for (c, byte) in bytes[i].into_iter().enumerate() {
                let v = f64::from(byte) / 255.0 - 0.5;
                let dc = if old { v / 0.15 } else { v / C0 };
                near(ending, f64::from(s.sh_of(i)[c]), dc, 0.51 / 255.0 / 0.15);
            }
            near("opacity", f64::from(s.opacity(i)), 230.0 / 255.0, 1e-6);
            for scale in s.scale(i) {
                near("scale", f64::from(scale).ln(), 0.1f64.ln(), 0.51 / 16.0);
            }
        }
    }
    let (Some(gzip), Some(raw)) = (load("-v2.spz"), load("-raw.spz")) else { return };
    assert_eq!(gzip.0, raw.0);
}

/// 152,746 Gaussians packed by SuperSplat, against a second decoding of single fields.
#[test]
fn playcanvas_compressed_ply_is_unpacked() {
    let Some(path) = shared("fixtures/splats/playcanvas_biker.compressed.ply") else { return };
    let bytes = std::fs::read(&path).unwrap();
    let s = load_splats(&path).unwrap();
    assert_eq!((s.len(), s.sh_degree()), (152_746, 0));
    let info = splat_info(&path).unwrap();
    assert_eq!(info.flavour, "compressed ply binary_little_endian");
    assert_eq!(info.comments, ["Generated by SuperSplat 2.7.1"]);
    let chunks = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let vertices = chunks + 597 * 72;
    assert_eq!(bytes.len(), vertices + 152_746 * 16);
    let mut largest_seen = [0; 4];
    for i in (0..152_746).step_by(97) {
        let bound = |k: usize| {
            let at = chunks + 72 * (i / 256) + 4 * k;
            f64::from(f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()))
        };
        let word = |k: usize| {
            let at = vertices + 16 * i + 4 * k;
            u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
        };
        let part = |v: u32, shift: u32, top: u32| f64::from(v >> shift & top) / f64::from(top);
        for (c, (shift, top)) in [(21, 2047), (11, 1023), (0, 2047)].into_iter().enumerate() {
            let mix = |low: usize, t: f64| bound(low) + (bound(low + 3) - bound(low)) * t;
            near("mean", f64::from(s.mean(i)[c]), mix(c, part(word(0), shift, top)), 1e-5);
            let log = mix(6 + c, part(word(2), shift, top));
            near("scale", f64::from(s.scale(i)[c]).ln(), log, 1e-5);
            let rgb = mix(12 + c, part(word(3), 24 - 8 * c as u32, 255));
            near("colour", 0.5 + C0 * f64::from(s.sh_of(i)[c]), rgb, 1e-6);
        }
        near("opacity", f64::from(s.opacity(i)), part(word(3), 0, 255), 1e-6);
        // The three stored components, in the order of what is left of w x y z.
        let largest = (word(1) >> 30) as usize;
        largest_seen[largest] += 1;
        let q = s.quat_wxyz(i).map(f64::from);
        let stored: Vec<f64> = (0..4).filter(|k| *k != largest).map(|k| q[k]).collect();
        for (k, v) in stored.into_iter().enumerate() {
            let t = part(word(1), 20 - 10 * k as u32, 1023);
            near("quaternion", v, (t - 0.5) * std::f64::consts::SQRT_2, 1e-5);
        }
        assert!(q[largest] >= q.iter().fold(0.0, |m: f64, v| m.max(v.abs())) - 2e-3);
    }
    assert!(largest_seen.iter().all(|n| *n > 0), "{largest_seen:?}");
}

/// 138,766 points of gsplat's garden scene through our .ply and back.
#[test]
fn garden_points_survive_a_ply() {
    let Some(path) = shared("fixtures/splats/gsplat_test_garden.npz") else { return };
    let mut npz = zip::ZipArchive::new(std::fs::File::open(&path).unwrap()).unwrap();
    let mut array = |name: &str| {
        let mut file = Vec::new();
        npz.by_name(name).unwrap().read_to_end(&mut file).unwrap();
        file
    };
    let means = npy::floats(&array("means3d.npy"));
    let colours = npy::bytes(&array("colors.npy"));
    let n = means.len() / 3;
    assert_eq!((n, colours.len()), (138_766, 3 * n));
    let mut random = Random(4);
    let mut rows = Vec::with_capacity(n * 11);
    for m in means.chunks_exact(3) {
        rows.extend(m);
        rows.extend([(); 4].map(|()| random.within(-1.0, 1.0) as f32));
        rows.extend([(); 3].map(|()| random.within(0.001, 0.1) as f32));
        rows.push(random.within(0.0, 1.0) as f32);
    }
    let sh = colours.iter().map(|c| ((f64::from(*c) / 255.0 - 0.5) / C0) as f32).collect();
    let s = Splats::new(rows, sh, Vec::new(), 0, ShBasis::Standard).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("garden.ply");
    save_splats(&copy, &s, &SaveOptions::default()).unwrap();
    let back = load_splats(&copy).unwrap();
    assert_eq!(back.sh(), s.sh());
    for i in 0..n {
        assert_eq!(back.mean(i), s.mean(i));
    }
    assert_same(&s, &back, &in_order(&s), DMat3::IDENTITY, 0, EXACT);
}

/// Names and types of a vertex, and how to encode a row of f64.
#[derive(Clone, Debug)]
pub(crate) struct Dialect {
    pub(crate) format: &'static str,
    pub(crate) types: Vec<(&'static str, String)>,
}

impl Dialect {
    fn encode(&self, kind: &str, v: f64, out: &mut Vec<u8>) {
        let big = self.format == "binary_big_endian";
        let mut put = |mut b: Vec<u8>| {
            if big {
                b.reverse();
            }
            out.extend(b);
        };
        match (self.format, kind) {
            ("ascii", _) => out.extend(format!("{v} ").bytes()),
            (_, "float" | "float32") => put((v as f32).to_le_bytes().to_vec()),
            (_, "double" | "float64") => put(v.to_le_bytes().to_vec()),
            (_, "uchar" | "uint8") => put(vec![v as u8]),
            (_, "ushort") => put((v as u16).to_le_bytes().to_vec()),
            (_, "int") => put((v as i32).to_le_bytes().to_vec()),
            _ => panic!("{kind}"),
        }
    }

    /// A file with extra elements before and after, lists included.
    pub(crate) fn file(
        &self,
        newline: &str,
        rows: usize,
        value: impl Fn(usize, &str) -> f64,
    ) -> Vec<u8> {
        let mut head = vec![
            "ply".to_owned(),
            format!("format {} 1.0", self.format),
            "comment Exported by nobody".to_owned(),
            "obj_info nothing".to_owned(),
            "element camera 2".to_owned(),
            "property list uchar int vertex_indices".to_owned(),
            "property double focal".to_owned(),
            format!("element vertex {rows}"),
        ];
        head.extend(self.types.iter().map(|(kind, name)| format!("property {kind} {name}")));
        head.extend(
            ["element face 1", "property list uchar int vertex_indices", "end_header"]
                .map(str::to_owned),
        );
        let mut out: Vec<u8> =
            head.iter().flat_map(|l| format!("{l}{newline}").into_bytes()).collect();
        let end_row = |out: &mut Vec<u8>| {
            if self.format == "ascii" {
                out.extend(newline.bytes());
            }
        };
        for length in [3, 0] {
            self.encode("uchar", f64::from(length), &mut out);
            (0..length).for_each(|k| self.encode("int", f64::from(-k), &mut out));
            self.encode("double", 1.5, &mut out);
            end_row(&mut out);
        }
        for i in 0..rows {
            for (kind, name) in &self.types {
                self.encode(kind, value(i, name), &mut out);
            }
            end_row(&mut out);
        }
        self.encode("uchar", 1.0, &mut out);
        self.encode("int", 7.0, &mut out);
        end_row(&mut out);
        out
    }
}

/// A number for every property of every Gaussian, exact in f32.
pub(crate) fn number(i: usize, name: &str) -> f64 {
    let seed =
        name.bytes().fold(i as u64 * 1000, |h, b| h.wrapping_mul(31).wrapping_add(u64::from(b)));
    match name {
        "red" | "green" | "blue" => (seed % 256) as f64,
        _ => f64::from(Random(seed).within(-2.0, 2.0) as f32),
    }
}

#[test]
fn every_dialect_of_ply_reads_the_same() {
    let base = [
        "x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
        "rot_3",
    ];
    let mut files = 0;
    for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
        for (rests, degree) in [(0, 0), (9, 1), (24, 2), (45, 3), (72, 4)] {
            for colours in [["f_dc_0", "f_dc_1", "f_dc_2"], ["red", "green", "blue"]] {
                for float in ["float", "double", "float32", "float64"] {
                    let byte = if colours[0] == "red" { "uchar" } else { float };
                    let mut types: Vec<(&str, String)> = Vec::new();
                    types.extend(base.map(|n| (float, n.to_owned())));
                    types.extend(colours.map(|n| (byte, n.to_owned())));
                    types.extend((0..rests).map(|k| (float, format!("f_rest_{k}"))));
                    types.push(("ushort", "confidence".to_owned()));
                    // Any order will do.
                    let mut random = Random(rests as u64);
                    for k in (1..types.len()).rev() {
                        types.swap(k, random.below(k + 1));
                    }
                    let dialect = Dialect { format, types };
                    let newline = if float == "double" { "\r\n" } else { "\n" };
                    let bytes = dialect.file(newline, 5, |i, n| match n {
                        "confidence" => 300.0,
                        _ => number(i, n),
                    });
                    let s = parse_ply(&bytes, "dialect.ply").unwrap();
                    assert_eq!((s.len(), s.sh_degree()), (5, degree), "{format} {float}");
                    for i in 0..5 {
                        check_dialect(&s, i, rests, colours);
                    }
                    files += 1;
                }
            }
        }
    }
    assert_eq!(files, 3 * 5 * 2 * 4);
}

pub(crate) fn check_dialect(s: &Splats, i: usize, rests: usize, colours: [&str; 3]) {
    for (c, axis) in ["x", "y", "z"].into_iter().enumerate() {
        assert_eq!(f64::from(s.mean(i)[c]), number(i, axis));
        let log = number(i, &format!("scale_{c}"));
        near("scale", f64::from(s.scale(i)[c]).ln(), log, 1e-6);
        let dc = match colours[0] {
            "red" => (number(i, colours[c]) / 255.0 - 0.5) / C0,
            _ => number(i, colours[c]),
        };
        near("dc", f64::from(s.sh_of(i)[c]), dc, 1e-6);
        for k in 0..rests / 3 {
            let rest = number(i, &format!("f_rest_{}", c * (rests / 3) + k));
            assert_eq!(f64::from(s.sh_of(i)[3 * (k + 1) + c]), rest);
        }
    }
    near("opacity", f64::from(s.opacity(i)), 1.0 / (1.0 + (-number(i, "opacity")).exp()), 1e-6);
    let q = [0, 1, 2, 3].map(|k| number(i, &format!("rot_{k}")));
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    (0..4).for_each(|k| near("rot", f64::from(s.quat_wxyz(i)[k]), q[k] / norm, 1e-6));
}

#[test]
fn infinite_logits_have_a_meaning_and_zero_quaternions_have_none() {
    let text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
        property float z\nproperty float f_dc_0\nproperty float f_dc_1\nproperty float f_dc_2\n\
        property float opacity\nproperty float scale_0\nproperty float scale_1\n\
        property float scale_2\nproperty float rot_0\nproperty float rot_1\n\
        property float rot_2\nproperty float rot_3\nend_header\n\
        0 0 0 0 0 0 inf 0 0 -inf 3 0 0 0\n4 5 6 1 1 1 2 0 0 0 0 0 0 0\n\
        1 2 3 0 0 0 -inf 0 0 0 0 0 5 0\n";
    let s = parse_ply(text.as_bytes(), "ends.ply").unwrap();
    assert_eq!((s.len(), s.opacity(0), s.opacity(1)), (2, 1.0, 0.0));
    assert_eq!(s.scale(0), [1.0, 1.0, 0.0]);
    assert_eq!((s.quat_wxyz(0), s.quat_wxyz(1)), ([1., 0., 0., 0.], [0., 0., 1., 0.]));
}

/// Our writer of version 3, repacked as the versions that we only read.
#[test]
fn spz_rotations_and_positions_of_old_versions() {
    // One Gaussian: half turn about y, and a position that f16 and fixed point both hold.
    let body = |version: u32| {
        let mut b = b"NGSP".to_vec();
        b.extend(version.to_le_bytes());
        b.extend(1u32.to_le_bytes());
        b.extend([0, 8, 0, 0]);
        for v in [1.5f32, -2.25, 0.5] {
            if version == 1 {
                b.extend(half::f16::from_f32(v).to_le_bytes());
            } else {
                b.extend(&((v * 256.0) as i32).to_le_bytes()[..3]);
            }
        }
        b.extend([128, 255, 0, 128, 160, 176, 144]);
        b.extend([128, 255, 128]);
        b
    };
    for version in [1, 2] {
        let s = subsplat::files::splats::spz::parse_spz(&body(version), "old.spz").unwrap();
        // Ours are turned by half a turn about x.
        assert_eq!(s.mean(0), [1.5, 2.25, -0.5]);
        let [sx, sy, sz] = s.scale(0).map(|v| f64::from(v).ln());
        near("ln σ", sx, 0.0, 1e-6);
        near("ln σ", sy, 1.0, 1e-6);
        near("ln σ", sz, -1.0, 1e-6);
        // Half turns about x, y and z leave the axes where they were.
        let c = covariance(&s, 0);
        near("xx", c.x_axis.x, 1.0, 0.2);
        near("yy", c.y_axis.y, 2f64.exp(), 0.2);
        near("zz", c.z_axis.z, (-2f64).exp(), 0.2);
        near("red", 0.15 * f64::from(s.sh_of(0)[0]) + 0.5, 1.0, 1e-6);
        near("green", 0.15 * f64::from(s.sh_of(0)[1]) + 0.5, 0.0, 1e-6);
        near("turn", covariance(&s, 0).x_axis.dot(DVec3::Y), 0.0, 0.1);
    }
}

/// A level-1 and a level-2 file of two buckets, one full and one not, made by hand.
#[test]
fn ksplat_buckets_and_harmonics() {
    for level in [1u16, 2] {
        let mut b = vec![0u8; 4096 + 1024];
        let put = |b: &mut Vec<u8>, at: usize, v: &[u8]| b[at..at + v.len()].copy_from_slice(v);
        put(&mut b, 1, &[1]);
        for (at, v) in [(4, 1u32), (8, 1), (12, 3), (16, 3)] {
            put(&mut b, at, &v.to_le_bytes());
        }
        put(&mut b, 20, &level.to_le_bytes());
        put(&mut b, 36, &(-2.0f32).to_le_bytes());
        put(&mut b, 40, &2.0f32.to_le_bytes());
        let section = 4096;
        for (at, v) in [(0, 3u32), (4, 3), (8, 2), (12, 2), (24, 1000), (32, 1), (36, 1)] {
            put(&mut b, section + at, &v.to_le_bytes());
        }
        put(&mut b, section + 16, &4.0f32.to_le_bytes());
        put(&mut b, section + 20, &12u16.to_le_bytes());
        put(&mut b, section + 40, &1u16.to_le_bytes());
        b.extend(1u32.to_le_bytes());
        for v in [10.0f32, 20.0, 30.0, -10.0, -20.0, -30.0] {
            b.extend(v.to_le_bytes());
        }
        for i in 0..3u16 {
            // 1000 is the middle, 2000 half a block of 4 above it.
            for v in [1000 + 500 * i, 2000, 0] {
                b.extend(v.to_le_bytes());
            }
            for v in [0.25f32, 0.5, 1.0, 0.5, 0.5, -0.5, 0.5] {
                b.extend(half::f16::from_f32(v).to_le_bytes());
            }
            b.extend([255, 0, 51, 51]);
            for k in 0..9u8 {
                match level {
                    1 => b.extend(half::f16::from_f32(f32::from(k) / 8.0).to_le_bytes()),
                    _ => b.push(51 * (k % 6)),
                }
            }
        }
        let s = subsplat::files::splats::ksplat::parse_ksplat(&b, "a.ksplat").unwrap();
        assert_eq!((s.len(), s.sh_degree()), (3, 1));
        for (i, centre) in
            [[10.0, 20.0, 30.0], [10.0, 20.0, 30.0], [-10.0, -20.0, -30.0]].into_iter().enumerate()
        {
            let steps = [i as f64, 2.0, -2.0];
            for c in 0..3 {
                near("mean", f64::from(s.mean(i)[c]), centre[c] + steps[c], 1e-5);
            }
            assert_eq!(s.scale(i), [0.25, 0.5, 1.0]);
            assert_eq!(s.quat_wxyz(i), [0.5, 0.5, -0.5, 0.5]);
            near("opacity", f64::from(s.opacity(i)), 0.2, 1e-6);
            for (c, v) in [1.0, 0.0, 0.2].into_iter().enumerate() {
                near("dc", 0.5 + C0 * f64::from(s.sh_of(i)[c]), v, 1e-6);
                for m in 0..3 {
                    let k = 3 * c + m;
                    let h = match level {
                        1 => k as f64 / 8.0,
                        _ => -2.0 + 4.0 * (51 * (k % 6)) as f64 / 255.0,
                    };
                    near("SH", f64::from(s.sh_of(i)[3 * (1 + m) + c]), h, 1e-6);
                }
            }
        }
    }
}
