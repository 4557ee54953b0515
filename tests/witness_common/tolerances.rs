//! How far each output may lie from what onnxruntime gave: largest difference over
//! largest magnitude. Every output has one row, every row its reason. Both sides compute
//! in f32 and sum in different orders, so a tolerance is a few times what was measured.

/// (case.outputs, tolerance, reason); outputs of one case, separated by blanks.
type Row = (&'static str, f64, &'static str);

/// MVSplat's backbone and the whole network.
const BACKBONE: &[Row] = &[
    ("cnn.half quarter", 5e-6, "convolutions with a norm after each: about an ulp a layer"),
    ("cnn_dim.half quarter", 5e-6, "convolutions with a norm after each: about an ulp a layer"),
    (
        "transformer.self0 layer0 self1 layer1 out",
        3e-6,
        "matrix products, softmax and LayerNorm, two layers",
    ),
    (
        "transformer3.self0 layer0 self1 layer1 out",
        3e-6,
        "matrix products, softmax and LayerNorm, two layers",
    ),
    ("sweep.disparities", 5e-7, "three operations"),
    (
        "sweep.correlation",
        2e-5,
        "sampling positions carry 1e-6 px of noise, features differ by 4 a pixel",
    ),
    ("sweep3.disparities", 5e-7, "three operations"),
    (
        "sweep3.correlation",
        2e-5,
        "sampling positions carry 1e-6 px of noise, features differ by 4 a pixel",
    ),
    ("unet.out", 1e-5, "some twenty convolutions with norms, attention"),
    (
        "depth.correlation",
        2e-5,
        "sampling positions carry 1e-6 px of noise, features differ by 4 a pixel",
    ),
    ("depth.refined_volume", 1e-5, "some twenty convolutions with norms, attention"),
    ("depth.pdf pdf_max", 1e-5, "softmax: the logits' absolute noise becomes relative"),
    ("depth.coarse_disp fullres_disp", 4e-6, "an average over candidates"),
    ("depth.upsampled projected", 4e-6, "one convolution, two convolutions"),
    ("depth.refine", 1.5e-5, "some twenty convolutions with norms, attention, twice in a row"),
    ("depth.delta raw densities", 1e-5, "two convolutions on refine"),
    ("depth.disparity", 1.5e-5, "the noise of delta, over a smaller range"),
    ("depth.depths", 2e-4, "1/disparity: far away its noise counts twentyfold"),
    ("adapter.means quats scales opacities sh sh_camera", 1e-6, "a formula of some ten operations"),
    ("backbone.cnn2 cnn4 trans4 trans8 trans16", 5e-6, "as transformer, after the CNN"),
    ("backbone.refine1", 3e-5, "as depth.refine, after CNN and transformer"),
    ("backbone.raw densities opacities sh sh_camera", 1e-5, "two convolutions on refine1"),
    ("backbone.disparity", 2e-5, "the noise of refine1, over a smaller range"),
    ("backbone.means scales", 2e-4, "as depth.depths"),
    ("backbone.quats", 5e-5, "raw quaternions of small norm are divided by it"),
    (
        "whole_paper.depths means log_scales opacities",
        6e-5,
        "as backbone.means, with a nearer far plane; then six layers",
    ),
    ("whole_paper.steps", 3e-4, "differences of f32 means that are thirty times as large"),
    ("whole_paper.quats", 2e-4, "as backbone.quats, turned by a head's output"),
    ("whole_paper.gain sh", 2e-5, "as backbone.raw; then six layers"),
    ("whole_tuned.depths means", 6e-5, "as whole_paper"),
    (
        "whole_tuned.steps log_scales opacities quats gain",
        1e-3,
        "the occlusion gate takes differences of depth over 2 % of it",
    ),
    ("whole_tuned.sh", 2e-5, "as backbone.raw"),
];

/// What SubSplat adds.
const SUBSPLAT: &[Row] = &[];

/// (case.output, tolerance) of every output.
pub fn table() -> impl Iterator<Item = (String, f64)> {
    BACKBONE.iter().chain(SUBSPLAT).flat_map(|&(names, tolerance, _)| {
        let (case, outputs) = names.split_once('.').expect("case.outputs");
        outputs.split(' ').map(move |output| (format!("{case}.{output}"), tolerance))
    })
}

/// The tolerance of an output.
pub fn of(case: &str, output: &str) -> f64 {
    let name = format!("{case}.{output}");
    let row = table().find(|row| row.0 == name);
    row.unwrap_or_else(|| panic!("{name}: no row in the table of tolerances")).1
}
