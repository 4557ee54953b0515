//! Constants of the WGSL kernels: declarations in WGSL, written from the constants of Rust.
//!
//! Constants that CPU and GPU share are in [`crate::layout`], those of the GPU alone beside the code
//! that they concern. A constant of one WGSL file alone is in that file.

use crate::gpu::finish::loss::LOSS_TAPS;
use crate::gpu::finish::optimiser::{PARAMETERS_MAX, RANGE_INSIDE, RANGE_OUTSIDE};
use crate::gpu::network::NONE;
use crate::gpu::network::attention_gather::{GATHER_SAMPLES_MAX, GATHER_WEIGHTS_MAX};
use crate::gpu::network::plane_sweep::SWEEP_PAIR_STRIDE;
use crate::gpu::raster::constants as raster;
use crate::gpu::spgr::SPGR_CAMERA_STRIDE;
use crate::layout as abi;
use crate::layout::OpacityRule;
use crate::layout::parameters::{Buffer, ELEMENTS_MAX, Form};

/// Returns name and value of constants of a module.
macro_rules! named {
    ($kind:ident, $module:ident: $($name:ident),+ $(,)?) => {
        &[$((stringify!($name), $module::$name as $kind)),+]
    };
}

const INTEGERS: [&[(&str, u32)]; 3] = [
    named!(u32, abi:
        HEAD_DEPTH_OFFSET, HEAD_GAIN_OFFSET, HEAD_LOGIT_OFFSET, HEAD_LOG_SCALE_OFFSET,
        HEAD_ROTATION_OFFSET, HEAD_STRIDE, HEAD_UV_OFFSET, MEAN_OFFSET, OPACITY_OFFSET,
        QUAT_OFFSET, SCALE_OFFSET, SPLAT_STRIDE,
    ),
    named!(u32, raster:
        FOOTPRINT_STRIDE, GPU_BLOCK, PAIR_SUMS, PLAN_BLOCKS, PLAN_COUNT, PLAN_ELEMENT_GROUPS,
        PLAN_REQUESTED, TILE_GPU,
    ),
    &[
        ("BUFFER_GAIN", Buffer::Gain as u32),
        ("BUFFER_SH", Buffer::Sh as u32),
        ("FORM_COMMON_FACTOR", Form::CommonFactor as u32),
        ("FORM_DIRECTION", Form::Direction as u32),
        ("FORM_FACTOR", Form::Factor as u32),
        ("FORM_LOGIT", Form::Logit as u32),
        ("FORM_PIXEL_OFFSET", Form::PixelOffset as u32),
        ("ELEMENTS_MAX", ELEMENTS_MAX as u32),
        ("PARAMETERS_MAX", PARAMETERS_MAX as u32),
        ("RANGE_INSIDE", RANGE_INSIDE),
        ("RANGE_OUTSIDE", RANGE_OUTSIDE),
        ("GATHER_SAMPLES_MAX", GATHER_SAMPLES_MAX as u32),
        ("GATHER_WEIGHTS_MAX", GATHER_WEIGHTS_MAX as u32),
        ("LOSS_TAPS", LOSS_TAPS as u32),
        ("NONE", NONE),
        ("SPGR_CAMERA_STRIDE", SPGR_CAMERA_STRIDE as u32),
        ("SWEEP_PAIR_STRIDE", SWEEP_PAIR_STRIDE as u32),
        ("RULE_LINEAR", OpacityRule::Linear as u32),
        ("RULE_OPTICAL_DEPTH", OpacityRule::OpticalDepth as u32),
        ("RULE_TRANSMITTANCE", OpacityRule::Transmittance as u32),
        ("RULE_AREA", OpacityRule::Area as u32),
        ("RULE_NONE", OpacityRule::None as u32),
    ],
];

const NUMBERS: &[(&str, f32)] = named!(f32, abi:
    ALPHA_MIN, ALPHA_MIN_LOG2, AREA_EPS, AREA_RULE_OPACITY_MAX, AREA_SQ_EPS, DEPTH_FRACTION_MIN,
    DISCRIMINANT_MIN_MVSPLAT, DISC_AREA_SQ_MIN, GROWTH_MAX, OPACITY_CEILING, OPACITY_MAX,
    RADIUS_SIGMAS_MVSPLAT, RELATIVE_AREA_MIN, SPAN_SLACK_PX, SUPPORT_SLACK, VISIBLE_Z_MIN,
);

/// Returns the declarations of all constants.
pub(crate) fn wgsl() -> String {
    let integers = INTEGERS.iter().copied().flatten();
    let integers = integers.map(|(name, value)| format!("const {name}: u32 = {value}u;\n"));
    // As f64, the decimal digits denote the f32 exactly: no compiler can round them differently.
    let number =
        |&(name, value): &(&str, f32)| format!("const {name}: f32 = {:?};\n", f64::from(value));
    integers.chain(NUMBERS.iter().map(number)).collect()
}
