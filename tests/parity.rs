//! The encoder against the reference outputs of the public MVSplat.

mod common;

use common::shared;
use subsplat::model::compare::compare;
use subsplat::model::weights::Weights;

#[test]
fn every_stage_agrees_with_the_reference() {
    let (Some(weights), Some(reference)) = (
        shared("golden/mvsplat_weights.safetensors"),
        shared("golden/mvsplat_64x64_b1v2.safetensors"),
    ) else {
        return;
    };
    let report = compare(&Weights::load(&weights).unwrap(), &reference).unwrap();
    for r in &report.rows {
        let mark = if r.ok { "  " } else { "!!" };
        println!(
            "{mark} {:45} {:.2e} {:.2e} {:.2e} {:?}",
            r.tensor, r.max_abs, r.relative, r.allowed, r.note
        );
    }
    println!("not produced: {:?}", report.not_produced);
    assert!(report.ok());
    assert!(report.not_produced.is_empty() && report.unexpected_weights.is_empty());
}
