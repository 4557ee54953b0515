//! How far each output may lie from what onnxruntime gave: largest difference over
//! largest magnitude. One row per output, each with its reason. Both sides compute in
//! f32 and sum in different orders, so a row is a few times what was measured.

/// (case.output, tolerance, reason).
type Row = (&'static str, f64, &'static str);

/// MVSplat's backbone and the whole network.
const BACKBONE: &[Row] = &[
    ("cnn.half", 1e-5, "five convolutions, each normalised: a few ulp of noise a layer"),
    ("cnn.quarter", 1e-5, "as half, with eight more convolutions"),
    ("cnn_dim.half", 1e-4, "a contrast of 1e-3: colours less their mean lose 8 bits"),
    ("cnn_dim.quarter", 1e-4, "as half"),
];

/// What SubSplat adds.
const SUBSPLAT: &[Row] = &[];

/// Every row.
pub fn table() -> impl Iterator<Item = &'static Row> {
    BACKBONE.iter().chain(SUBSPLAT)
}

/// The tolerance of an output.
pub fn of(case: &str, output: &str) -> f64 {
    let name = format!("{case}.{output}");
    let row = table().find(|row| row.0 == name);
    row.unwrap_or_else(|| panic!("{name}: no row in the table of tolerances")).1
}
