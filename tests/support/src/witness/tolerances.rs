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
    ("sweep_close.disparities", 5e-7, "three operations"),
    ("sweep_close.correlation", 4e-5, "as sweep; a small z magnifies the noise of positions"),
    ("unet_dim.out", 1e-5, "as unet"),
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
        "whole_paper.depths means log_scales",
        6e-5,
        "as backbone.means, with a nearer far plane; then six layers",
    ),
    ("whole_paper.opacities", 1.5e-4, "a softmax of logits less the logarithm of areas"),
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

const EMBED: &str = "at most five layers with norms: some ten ulp";
const ATTENTION: &str =
    "matrix products and a softmax per stage; positions of samples carry 1e-6 px";
const HEAD: &str = "two to five layers";
const SPLAT: &str = "formulas of some twenty operations, in f64 on the other side";
const STEP: &str = "the difference of two means";
const DEPTH: &str =
    "ln(1 - opacity): parent 3 is opaque but for 4e-5, which f32 holds to three digits";
const DISC: &str = "(J Sigma J^T)^-1 of a needle of 1000 to 1 in f32; in f64 the bound is 2e-7";
const TRUNK: &str = "as attention, heads and children in a row";
const LITERAL: &str = "as TRUNK; logits of factor 1 in a softmax";
const SH: &str = "one polynomial and a sum";
const NEEDLE: &str =
    "a needle's short axis from a covariance in f32; the test holds the other form to 1e-6";
const SUPPORT: &str = "supports are widened by 1e-4 in log2 of alpha";
const PIXELS: &str = "3 px; the test bounds them on either side to the pixel";

/// Tolerances of SubSplat's modules and of the projection of splats.
const SUBSPLAT: &[Row] = &[
    ("sub_agg_add_ffn.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_bare_maps.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_cat.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_cat_ffn.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_clamp.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_clamp_hidden.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_faint.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_groups.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_integer.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_linear.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_linear_clamp.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_linear_two.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_literal.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_none_ffn.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_offsets.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_offsets_linear.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_paper.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_three_views.f_g f_a", 6e-6, ATTENTION),
    ("sub_agg_tuned.f_g f_a", 6e-6, ATTENTION),
    ("sub_embed_lite_raw.z_g z_a", 2e-6, EMBED),
    ("sub_embed_paper.z_g z_a", 2e-6, EMBED),
    ("sub_embed_tuned.z_g z_a", 2e-6, EMBED),
    ("sub_embed_view0.z_g z_a", 2e-6, EMBED),
    ("sub_ewa_antialiased.means2d depth", 5e-7, SPLAT),
    ("sub_ewa_antialiased.conic opacity", 5e-4, NEEDLE),
    ("sub_ewa_antialiased.half", 2e-4, SUPPORT),
    ("sub_ewa_antialiased.pixels wide", 4e-2, PIXELS),
    ("sub_ewa_mvsplat.means2d depth opacity", 5e-7, SPLAT),
    ("sub_ewa_mvsplat.conic", 5e-4, NEEDLE),
    ("sub_ewa_mvsplat.half", 2e-4, SUPPORT),
    ("sub_ewa_mvsplat.pixels wide", 4e-2, PIXELS),
    ("sub_ewa_mvsplat_large.means2d depth opacity", 5e-7, SPLAT),
    ("sub_ewa_mvsplat_large.conic", 5e-4, NEEDLE),
    ("sub_ewa_mvsplat_large.half", 2e-4, SUPPORT),
    ("sub_ewa_mvsplat_large.pixels wide", 4e-2, PIXELS),
    ("sub_ewa_standard.means2d depth opacity", 5e-7, SPLAT),
    ("sub_ewa_standard.conic", 5e-4, NEEDLE),
    ("sub_ewa_standard.half", 2e-4, SUPPORT),
    ("sub_ewa_standard.pixels wide", 4e-2, PIXELS),
    ("sub_ewa_standard_large.means2d depth opacity", 5e-7, SPLAT),
    ("sub_ewa_standard_large.conic", 5e-4, NEEDLE),
    ("sub_ewa_standard_large.half", 2e-4, SUPPORT),
    ("sub_ewa_standard_large.pixels wide", 4e-2, PIXELS),
    ("sub_head_coord.record", 1e-6, HEAD),
    ("sub_head_coord_4.record", 1e-6, HEAD),
    ("sub_head_mlp2.record", 1e-6, HEAD),
    ("sub_head_mlp2_3.record", 1e-6, HEAD),
    ("sub_head_pg.record", 1e-6, HEAD),
    ("sub_head_polynomial.record", 1e-6, HEAD),
    ("sub_head_polynomial_3.record", 1e-6, HEAD),
    (
        "sub_sh.standard_0 standard_1 standard_2 standard_3 standard_4 mvsplat_0 mvsplat_1 mvsplat_2 mvsplat_3 mvsplat_4",
        1e-6,
        SH,
    ),
    ("sub_spgr_area.steps", 2e-6, STEP),
    ("sub_spgr_area.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_area.opacities", 2e-6, SPLAT),
    ("sub_spgr_area_16.steps", 2e-6, STEP),
    ("sub_spgr_area_16.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_area_16.opacities", 2e-6, SPLAT),
    ("sub_spgr_area_parent.steps", 2e-6, STEP),
    ("sub_spgr_area_parent.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_area_parent.opacities", 2e-6, SPLAT),
    ("sub_spgr_depth.steps", 2e-6, STEP),
    ("sub_spgr_depth.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_depth.opacities", 3e-5, DEPTH),
    ("sub_spgr_depth_lowpass.steps", 2e-6, STEP),
    ("sub_spgr_depth_lowpass.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_depth_lowpass.opacities", 3e-5, DEPTH),
    ("sub_spgr_disc.steps", 1e-2, DISC),
    ("sub_spgr_disc.quats gain", 1e-6, SPLAT),
    ("sub_spgr_disc.log_scales", 1e-3, DISC),
    ("sub_spgr_disc.opacities", 1e-5, SPLAT),
    ("sub_spgr_disc_ray.steps", 1e-2, DISC),
    ("sub_spgr_disc_ray.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_disc_ray.opacities", 3e-4, DISC),
    ("sub_spgr_far.steps", 2e-6, STEP),
    ("sub_spgr_far.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_far.opacities", 2e-6, SPLAT),
    ("sub_spgr_near.steps", 2e-6, STEP),
    ("sub_spgr_near.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_near.opacities", 3e-5, DEPTH),
    ("sub_spgr_none.steps", 2e-6, STEP),
    ("sub_spgr_none.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_none.opacities", 2e-6, SPLAT),
    ("sub_spgr_none_16.steps", 2e-6, STEP),
    ("sub_spgr_none_16.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_none_16.opacities", 2e-6, SPLAT),
    ("sub_spgr_paper.steps", 2e-6, STEP),
    ("sub_spgr_paper.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_paper.opacities", 2e-6, SPLAT),
    ("sub_spgr_paper_16.steps", 2e-6, STEP),
    ("sub_spgr_paper_16.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_paper_16.opacities", 2e-6, SPLAT),
    ("sub_spgr_transmittance.steps", 2e-6, STEP),
    ("sub_spgr_transmittance.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_transmittance.opacities", 3e-5, DEPTH),
    ("sub_spgr_transmittance_16.steps", 2e-6, STEP),
    ("sub_spgr_transmittance_16.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_transmittance_16.opacities", 3e-5, DEPTH),
    ("sub_spgr_tuned.steps", 2e-6, STEP),
    ("sub_spgr_tuned.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_tuned.opacities", 3e-5, DEPTH),
    ("sub_spgr_tuned_16.steps", 2e-6, STEP),
    ("sub_spgr_tuned_16.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_tuned_16.opacities", 3e-5, DEPTH),
    ("sub_spgr_two_axis.steps", 2e-6, STEP),
    ("sub_spgr_two_axis.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_two_axis.opacities", 2e-6, SPLAT),
    ("sub_spgr_two_axis_depth.steps", 2e-6, STEP),
    ("sub_spgr_two_axis_depth.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_two_axis_depth.opacities", 3e-5, DEPTH),
    ("sub_spgr_two_axis_depth_16.steps", 2e-6, STEP),
    ("sub_spgr_two_axis_depth_16.quats log_scales gain", 1e-6, SPLAT),
    ("sub_spgr_two_axis_depth_16.opacities", 3e-5, DEPTH),
    ("sub_trunk_literal.steps quats log_scales opacities gain", 2e-5, LITERAL),
    ("sub_trunk_no_attention.steps quats log_scales opacities gain", 6e-6, TRUNK),
    ("sub_trunk_paper.steps quats log_scales opacities gain", 6e-6, TRUNK),
    ("sub_trunk_tuned.steps quats log_scales opacities gain", 6e-6, TRUNK),
];

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
