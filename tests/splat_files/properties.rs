//! Properties of files of Gaussians, on random cases of a fixed seed.

use crate::splat_fixtures::{Dialect, check_dialect, number};
use glam::{DMat3, DQuat, DVec3};
use proptest::prelude::*;
use proptest::sample::select;
use proptest::test_runner::RngSeed;
use serde_json::{Value, json};
use subsplat::files::splats::glb::parse_glb;
use subsplat::files::splats::ply::parse_ply;
use subsplat::files::{SaveOptions, SplatFormat, Up, encode_splats};
use subsplat_kernels::layout::ShBasis;
use subsplat_test_support::splat_scene::{EXACT, Kind, Tolerance, assert_same, in_order, scene};

/// The cases are the same in every run, and nothing is written where one fails.
fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        rng_seed: RngSeed::Fixed(0x5EED),
        failure_persistence: None,
        ..ProptestConfig::default()
    }
}

/// Properties of a .ply of Gaussians, each with a type of its own, in any order.
fn dialect() -> impl Strategy<Value = (Dialect, usize, [&'static str; 3])> {
    let formats = select(vec!["ascii", "binary_little_endian", "binary_big_endian"]);
    let rests = select(vec![0, 9, 24, 45, 72]);
    let colours = select(vec![["f_dc_0", "f_dc_1", "f_dc_2"], ["red", "green", "blue"]]);
    (formats, rests, colours).prop_flat_map(|(format, rests, colours)| {
        let base = ["x", "y", "z", "opacity"].map(str::to_owned).into_iter();
        let base = base.chain((0..3).map(|i| format!("scale_{i}")));
        let base = base.chain((0..4).map(|i| format!("rot_{i}")));
        let names: Vec<String> = base
            .chain(colours.map(str::to_owned))
            .chain((0..rests).map(|k| format!("f_rest_{k}")))
            .collect();
        let types = prop::collection::vec(select(vec!["float", "double", "float64"]), names.len());
        (Just(names), types).prop_flat_map(move |(names, types)| {
            let kind = |(name, kind): (String, &'static str)| {
                (
                    if name.len() > 2 && colours[0] == "red" && colours.contains(&&*name) {
                        "uchar"
                    } else {
                        kind
                    },
                    name,
                )
            };
            let mut all: Vec<(&str, String)> = names.into_iter().zip(types).map(kind).collect();
            // A property of another program.
            all.push(("ushort", "confidence".to_owned()));
            Just(all)
                .prop_shuffle()
                .prop_map(move |types| (Dialect { format, types }, rests, colours))
        })
    })
}

/// A random scene: its seed, SH and gains.
fn kind() -> impl Strategy<Value = (u64, Kind)> {
    let basis = select(vec![ShBasis::Standard, ShBasis::Mvsplat]);
    (any::<u64>(), 1..5usize, 1..4usize, 0..4usize, select(vec![0, 1, 4]), basis).prop_map(
        |(seed, parents, children, degree, gain_channels, basis)| {
            (seed, Kind { parents, children, degree, gain_channels, basis })
        },
    )
}

/// The .glb with the node of the Gaussians turned by `q` after its own rotation, scaled and moved.
fn with_node(glb: &[u8], q: DQuat, translation: DVec3, scale: f64) -> Vec<u8> {
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let mut json: Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
    let node = &mut json["nodes"][0];
    let own: [f64; 4] =
        serde_json::from_value(node["rotation"].clone()).unwrap_or([0.0, 0.0, 0.0, 1.0]);
    node["rotation"] = json!((q * DQuat::from_array(own)).to_array());
    node["translation"] = json!(translation.to_array());
    node["scale"] = json!([scale, scale, scale]);
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let rest = &glb[20 + length..];
    let mut out = glb[..8].to_vec();
    out.extend((20 + text.len() as u32 + rest.len() as u32).to_le_bytes());
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(b"JSON");
    [out, text, rest.to_vec()].concat()
}

proptest! {
    #![proptest_config(cases(96))]

    /// Any order and any types of the properties, in text and in both orders of bytes.
    #[test]
    fn a_ply_is_read_in_any_order_of_its_properties((dialect, rests, colours) in dialect(), crlf: bool) {
        let newline = if crlf { "\r\n" } else { "\n" };
        let value = |i: usize, name: &str| if name == "confidence" { 300.0 } else { number(i, name) };
        let bytes = dialect.file(newline, 3, value);
        let splats = parse_ply(&bytes, "dialect.ply").unwrap();
        prop_assert_eq!(splats.len(), 3);
        (0..3).for_each(|i| check_dialect(&splats, i, rests, colours));
    }

    /// Axes of a file turn means, covariances and colours together, in every basis and with any gain.
    #[test]
    fn the_axes_of_a_file_turn_the_whole_scene((seed, kind) in kind()) {
        let before = scene(seed, kind);
        let y = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let z = DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y);
        for (up, turn) in [(Up::Keep, DMat3::IDENTITY), (Up::Y, y), (Up::Z, z)] {
            let options = SaveOptions { up, ..SaveOptions::default() };
            let bytes = encode_splats(SplatFormat::Ply, &before, &options).unwrap();
            let after = parse_ply(&bytes, "turned.ply").unwrap();
            assert_same(&before, &after, &in_order(&before), turn, kind.degree, EXACT);
        }
    }

    /// A node of glTF turns, moves and scales what it has: SH of any degree by any rotation.
    #[test]
    fn any_rotation_of_a_node_turns_the_whole_scene(
        (seed, kind) in kind(),
        q in prop::array::uniform4(-1.0..1.0f64),
        at in prop::array::uniform3(-5.0..5.0f64),
        scale in 0.1..10.0f64,
    ) {
        prop_assume!(DQuat::from_array(q).length() > 0.1);
        let q = DQuat::from_array(q).normalize();
        let before = scene(seed, kind);
        let plain = encode_splats(SplatFormat::Glb, &before, &SaveOptions::default()).unwrap();
        let start = parse_glb(&plain, "plain.glb").unwrap();
        let after = parse_glb(&with_node(&plain, q, DVec3::from(at), scale), "turned.glb").unwrap();
        // The same Gaussians, moved in f64 here. The y and z of glTF point the other way.
        let turn = DQuat::from_xyzw(q.x, -q.y, -q.z, q.w);
        let at = DVec3::new(at[0], -at[1], -at[2]);
        let mut parts = start.clone().into_parts();
        for row in parts.rows.chunks_exact_mut(11) {
            let mean = DVec3::new(row[0].into(), row[1].into(), row[2].into());
            let moved = scale * mean + turn.inverse() * at;
            row[..3].copy_from_slice(&moved.as_vec3().to_array());
            row[7..10].iter_mut().for_each(|s| *s = (f64::from(*s) * scale) as f32);
        }
        let moved = subsplat::scene::splats::Splats::try_from(parts).unwrap();
        let allowed = Tolerance { mean: 1e-5 * (1.0 + 10.0 * scale), ..EXACT };
        let allowed = Tolerance { covariance: 1e-5, colour: 1e-5, ..allowed };
        assert_same(&moved, &after, &in_order(&moved), DMat3::from_quat(turn), kind.degree, allowed);
    }
}
