//! The backbone and the whole network against an independent implementation: graphs
//! written from the specification in `tools/witness`, run by onnxruntime. No Python is
//! needed here; `tools/witness/verify.py` holds the goldens against onnxruntime.

mod witness_common;

use candle_core::Result;
use std::collections::BTreeSet;
use subsplat::model::backbone::cnn::Cnn;
use subsplat::model::trace::Trace;
use witness_common::{Golden, folder, tolerances};

#[test]
fn cnn() -> Result<()> {
    for name in ["cnn", "cnn_dim"] {
        let golden = Golden::load(name);
        let weights = golden.weights();
        let cnn = Cnn::new([8, 12, 16], weights.builder().pp("backbone.backbone"))?;
        let out = cnn.forward(&golden.input("images"), &mut Trace::off())?;
        golden.compare("half", &out.half);
        golden.compare("quarter", &out.quarter);
        golden.done(&weights);
    }
    Ok(())
}

/// Goldens and the table of tolerances name the same outputs.
#[test]
fn every_output_has_a_tolerance_and_every_tolerance_an_output() {
    let mut outputs = BTreeSet::new();
    for entry in std::fs::read_dir(folder()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "safetensors") {
            let name = path.file_stem().unwrap().to_string_lossy().into_owned();
            let golden = Golden::load(&name);
            outputs.extend(golden.about.outputs.keys().map(|output| format!("{name}.{output}")));
        }
    }
    let rows: BTreeSet<String> = tolerances::table().map(|row| row.0.to_owned()).collect();
    assert_eq!(outputs, rows);
    assert_eq!(rows.len(), tolerances::table().count(), "a row stands twice");
}
