//! How far each output may lie from what onnxruntime gave: largest difference over
//! largest magnitude. One row per output, each with its reason. Both sides compute in
//! f32 and sum in different orders, so a row is a few times what was measured.

/// (case.output, tolerance, reason).
type Row = (&'static str, f64, &'static str);

/// MVSplat's backbone and the whole network.
const BACKBONE: &[Row] = &[
    ("cnn.half", 5e-6, "convolutions with a norm after each: about an ulp of noise a layer"),
    ("cnn.quarter", 5e-6, "convolutions with a norm after each: about an ulp of noise a layer"),
    (
        "cnn_dim.half",
        5e-6,
        "convolutions with a norm after each: about an ulp of noise a layer; a wrong eps is 1e-2",
    ),
    (
        "cnn_dim.quarter",
        5e-6,
        "convolutions with a norm after each: about an ulp of noise a layer; a wrong eps is 1e-2",
    ),
    ("transformer.self0", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("transformer.layer0", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("transformer.self1", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("transformer.layer1", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("transformer.out", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("transformer3.self0", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("transformer3.layer0", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("transformer3.self1", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("transformer3.layer1", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("transformer3.out", 3e-6, "matrix products, softmax and LayerNorm, two layers"),
    ("sweep.disparities", 5e-7, "three operations"),
    (
        "sweep.correlation",
        2e-5,
        "sampling positions of some ten pixels carry 1e-6 px of noise, features differ by 4 a pixel",
    ),
    ("sweep3.disparities", 5e-7, "three operations"),
    (
        "sweep3.correlation",
        2e-5,
        "sampling positions of some ten pixels carry 1e-6 px of noise, features differ by 4 a pixel",
    ),
    ("unet.out", 1e-5, "some twenty convolutions with norms; attention over both views"),
    (
        "depth.correlation",
        2e-5,
        "sampling positions of some ten pixels carry 1e-6 px of noise, features differ by 4 a pixel",
    ),
    (
        "depth.refined_volume",
        1e-5,
        "some twenty convolutions with norms; attention over both views",
    ),
    ("depth.pdf", 1e-5, "a softmax makes relative noise of the logits' absolute noise"),
    ("depth.pdf_max", 1e-5, "a softmax makes relative noise of the logits' absolute noise"),
    ("depth.coarse_disp", 4e-6, "an average over candidates"),
    ("depth.fullres_disp", 4e-6, "an average over candidates"),
    ("depth.upsampled", 4e-6, "one and two convolutions"),
    ("depth.projected", 4e-6, "one and two convolutions"),
    (
        "depth.refine",
        1.5e-5,
        "some twenty convolutions with norms; attention over both views after another such",
    ),
    ("depth.delta", 1e-5, "two convolutions on refine"),
    ("depth.raw", 1e-5, "two convolutions on refine"),
    ("depth.densities", 1e-5, "two convolutions on refine"),
    ("depth.disparity", 1.5e-5, "the noise of delta, over a smaller range"),
    ("depth.depths", 2e-4, "1/disparity: far away, the noise of disparity counts forty times"),
    ("adapter.means", 1e-6, "a formula of some ten operations"),
    ("adapter.quats", 1e-6, "a formula of some ten operations"),
    ("adapter.scales", 1e-6, "a formula of some ten operations"),
    ("adapter.opacities", 1e-6, "a formula of some ten operations"),
    ("adapter.sh", 1e-6, "a formula of some ten operations"),
    ("adapter.sh_camera", 1e-6, "a formula of some ten operations"),
    ("backbone.cnn2", 5e-6, "as transformer, after the CNN"),
    ("backbone.cnn4", 5e-6, "as transformer, after the CNN"),
    ("backbone.trans4", 5e-6, "as transformer, after the CNN"),
    ("backbone.trans8", 5e-6, "as transformer, after the CNN"),
    ("backbone.trans16", 5e-6, "as transformer, after the CNN"),
    ("backbone.refine1", 3e-5, "as depth.refine, after CNN and transformer"),
    ("backbone.raw", 1e-5, "two convolutions on refine1"),
    ("backbone.densities", 1e-5, "two convolutions on refine1"),
    ("backbone.opacities", 1e-5, "two convolutions on refine1"),
    ("backbone.sh", 1e-5, "two convolutions on refine1"),
    ("backbone.sh_camera", 1e-5, "two convolutions on refine1"),
    ("backbone.disparity", 2e-5, "the noise of refine1, over a smaller range"),
    ("backbone.means", 2e-4, "as depth.depths"),
    ("backbone.scales", 2e-4, "as depth.depths"),
    ("backbone.quats", 5e-5, "raw quaternions of small norm are divided by it"),
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
    row.map_or(1e-2, |r| r.1)
}
