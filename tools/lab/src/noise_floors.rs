//! Numerical noise of MVSplat in f32, tensor by tensor: max |a − b| over max |a| between
//! PyTorch's two CPU back ends (oneDNN on two threads, native on one) on the reference
//! inputs. A port may differ by ten times as much ([`ALLOWANCE`]).
//!
//! Depth is 1/disparity over a range of 100. Its noise, and that of means, scales and
//! covariances, is therefore hundreds of times the noise of disparity.

/// Factor on the noise floor.
pub const ALLOWANCE: f32 = 10.0;

/// Floor of tensors that are not listed: the largest of the feature maps.
const DEFAULT: f32 = 6.3e-6;

/// Returns the noise floor of tensor `name`, relative to its largest entry.
pub fn noise_floor(name: &str) -> f32 {
    let listed = MEASURED.iter().chain(EXACT).find(|(n, _)| *n == name);
    listed.map_or(DEFAULT, |(_, floor)| *floor)
}

/// Tensors that both back ends compute with the same code, so that no noise can be
/// measured. The comments give the reason for each floor.
const EXACT: &[(&str, f32)] = &[
    // Products of inputs: one rounding each.
    ("cnn.normalized_image", 1.2e-7),
    ("cv.K_px.0", 1.2e-7),
    ("cv.disp_candidates_vb", 1.2e-7),
    ("gauss.sh_mask", 1.2e-7),
    // PyTorch inverts in f32 by elimination, this crate in f64.
    ("cv.pose.0", 2.4e-7),
    // e3nn's acos loses half of the digits for a camera that is almost level (up to
    // 5e-4); the rotation here is exact.
    ("gauss.sh_angles_abg", 5.0e-5),
    ("gauss.sh_wigner_D", 5.0e-5),
    // Disparity of the refined depth, a row that only this crate derives.
    ("1/gauss.depths", 5.0e-6),
];

/// Measured floors.
const MEASURED: &[(&str, f32)] = &[
    ("cnn.conv1", 4.6e-07),
    ("cnn.features", 1.9e-06),
    ("cnn.layer1", 7.5e-07),
    ("cnn.layer2", 1.2e-06),
    ("cnn.layer3", 2.1e-06),
    ("cnn.out_bv", 1.9e-06),
    ("cv.corr_refine_net.0", 8.2e-07),
    ("cv.corr_refine_net.1", 1.0e-06),
    ("cv.corr_refine_net.2", 1.2e-06),
    ("cv.corr_refine_net.3.input_blocks.0", 8.9e-07),
    ("cv.corr_refine_net.3.input_blocks.1", 1.3e-06),
    ("cv.corr_refine_net.3.input_blocks.2", 1.3e-06),
    ("cv.corr_refine_net.3.input_blocks.3", 1.2e-06),
    ("cv.corr_refine_net.3.input_blocks.4", 1.1e-06),
    ("cv.corr_refine_net.3.input_blocks.5", 1.2e-06),
    ("cv.corr_refine_net.3.middle_block.0", 1.3e-06),
    ("cv.corr_refine_net.3.middle_block.2", 1.4e-06),
    ("cv.corr_refine_net.3.out", 1.4e-06),
    ("cv.corr_refine_net.3.output_blocks.0", 7.4e-07),
    ("cv.corr_refine_net.3.output_blocks.1", 9.2e-07),
    ("cv.corr_refine_net.3.output_blocks.2", 1.2e-06),
    ("cv.corr_refine_net.3.output_blocks.3", 1.6e-06),
    ("cv.corr_refine_net.3.output_blocks.4", 1.8e-06),
    ("cv.corr_refine_net.3.output_blocks.5", 1.9e-06),
    ("cv.corr_refine_net.out_vb", 2.0e-06),
    ("cv.raw_correlation_vb", 6.1e-07),
    ("cv.refined_correlation_vb", 8.9e-07),
    ("cv.regressor_residual_vb", 8.8e-07),
    ("cv.warped_d0_d64_d127.0", 1.1e-06),
    ("depth.coarse_disp_vb", 3.5e-06),
    ("depth.fullres_disp_vb", 3.1e-06),
    ("depth.logits_vb", 1.7e-06),
    ("depth.pdf_max_fullres_vb", 4.1e-06),
    ("depth.pdf_max_vb", 4.1e-06),
    ("depth.pdf_vb", 4.4e-06),
    ("depth.proj_feature_vb", 1.6e-06),
    ("depth.refine_unet.0", 1.7e-06),
    ("depth.refine_unet.1", 2.5e-06),
    ("depth.refine_unet.2", 2.4e-06),
    ("depth.refine_unet.3.input_blocks.0", 2.1e-06),
    ("depth.refine_unet.3.input_blocks.1", 3.4e-06),
    ("depth.refine_unet.3.input_blocks.2", 2.4e-06),
    ("depth.refine_unet.3.input_blocks.3", 5.3e-06),
    ("depth.refine_unet.3.input_blocks.4", 3.0e-06),
    ("depth.refine_unet.3.input_blocks.5", 4.7e-06),
    ("depth.refine_unet.3.input_blocks.6", 5.4e-06),
    ("depth.refine_unet.3.input_blocks.7", 3.9e-06),
    ("depth.refine_unet.3.input_blocks.8", 5.1e-06),
    ("depth.refine_unet.3.input_blocks.9", 4.5e-06),
    ("depth.refine_unet.3.middle_block.0", 5.0e-06),
    ("depth.refine_unet.3.middle_block.2", 5.2e-06),
    ("depth.refine_unet.3.out", 5.3e-06),
    ("depth.refine_unet.3.output_blocks.0", 2.8e-06),
    ("depth.refine_unet.3.output_blocks.1", 1.9e-06),
    ("depth.refine_unet.3.output_blocks.2", 4.4e-06),
    ("depth.refine_unet.3.output_blocks.3", 4.7e-06),
    ("depth.refine_unet.3.output_blocks.4", 4.8e-06),
    ("depth.refine_unet.3.output_blocks.5", 4.4e-06),
    ("depth.refine_unet.3.output_blocks.6", 5.6e-06),
    ("depth.refine_unet.3.output_blocks.7", 4.7e-06),
    ("depth.refine_unet.3.output_blocks.8", 6.3e-06),
    ("depth.refine_unet.3.output_blocks.9", 6.2e-06),
    ("depth.refine_unet.in_vb", 3.0e-06),
    ("depth.to_disparity_vb", 1.0e-05),
    ("depth.to_gaussians_vb", 3.6e-06),
    ("depth.upsampler.0", 1.3e-06),
    ("depth.upsampler_vb", 1.9e-06),
    ("gauss.depths", 2.8e-04),
    ("gauss.opacities_in", 1.1e-05),
    ("gauss.raw82", 3.6e-06),
    ("gauss.rotations_xyzw", 3.8e-05),
    ("gauss.scales", 1.9e-04),
    ("gauss.xy_ray", 6.0e-08),
    ("out.covariances", 3.0e-04),
    ("out.harmonics", 5.5e-06),
    ("out.means", 2.5e-04),
    ("out.opacities", 1.1e-05),
    ("transformer.features", 1.3e-06),
    ("transformer.layer0.out_vb", 1.3e-06),
    ("transformer.layer0.self_attn_vb", 1.3e-06),
    ("transformer.layer1.out_vb", 1.3e-06),
    ("transformer.layer1.self_attn_vb", 1.2e-06),
    ("transformer.layer2.out_vb", 1.4e-06),
    ("transformer.layer2.self_attn_vb", 1.3e-06),
    ("transformer.layer3.out_vb", 1.2e-06),
    ("transformer.layer3.self_attn_vb", 1.2e-06),
    ("transformer.layer4.out_vb", 1.3e-06),
    ("transformer.layer4.self_attn_vb", 1.3e-06),
    ("transformer.layer5.out_vb", 1.3e-06),
    ("transformer.layer5.self_attn_vb", 1.2e-06),
    ("transformer.pos_added", 1.8e-06),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_is_noisier_than_features() {
        assert!(noise_floor("out.means") > 1e-4 && noise_floor("cnn.layer3") < 3e-6);
        assert_eq!(noise_floor("cv.pose.0"), 2.4e-7);
        assert_eq!(noise_floor("no such tensor"), DEFAULT);
    }
}
