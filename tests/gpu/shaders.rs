//! Checks of the WGSL kernels without a GPU. naga validates every kernel; constants, uniforms and
//! arguments equal those of the Rust side; kernels respect WebGPU's default limits; every kernel
//! has a CPU version.

use naga::proc::Layouter;
use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{AddressSpace, Expression, Handle, Literal, Module, StorageAccess, TypeInner};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::PathBuf;
use subsplat_kernels::gpu::{Access, KERNELS, Kernel};
use subsplat_kernels::layout as abi;
use subsplat_kernels::layout::*;

/// WebGPU's default limits: storage buffers per stage, threads and bytes per workgroup.
const STORAGE_MAX: usize = 8;
const THREADS_MAX: u32 = 256;
const WORKGROUP_BYTES_MAX: u32 = 16 << 10;

/// Kernels whose CPU version has another stem.
const CPU_STEMS: &[(&str, &str)] = &[
    ("adapter_colours", "adapter"),
    ("sort_count", "sort"),
    ("sort_scatter", "sort"),
    ("scan_reduce", "tiles"),
    ("scan_whole", "tiles"),
    ("scan_apply", "tiles"),
    ("plan", "tiles"),
    ("pick", "tiles"),
    ("intersect", "tiles"),
    ("ranges", "tiles"),
    ("rasterize_bwd", "raster_bwd"),
    ("pair_sums", "raster_bwd"),
    ("redistribute_bwd", "redistribute"),
    ("show", "rasterize"),
    ("spgr_bwd", "spgr"),
    ("spgr_gains_bwd", "spgr"),
    ("invert", "plane_sweep"),
    ("attention_gather_bwd", "attention_gather"),
    ("attention_gather_scatter", "attention_gather"),
    ("plane_sweep_taps", "plane_sweep"),
    ("plane_sweep_reference_bwd", "plane_sweep"),
    ("plane_sweep_source_bwd", "plane_sweep"),
    ("convex", "small"),
    ("convolution", "conv"),
    ("cross_check", "small"),
    ("depth_consensus", "small"),
    // Copies and sums of tensors.
    ("elementwise", "activation"),
    ("expectation", "small"),
    ("head_output", "small"),
    ("layer_norm", "norm"),
    ("linear", "gemm"),
    ("norm_apply", "norm"),
    ("norm_statistics", "norm"),
    ("raw_matching_blocks", "matching"),
    ("raw_matching_scores", "matching"),
    ("reduce", "moves"),
    ("select_rows", "moves"),
    ("occlusion", "attention_gather"),
    ("attributes_bwd", "attributes"),
    ("convex_bwd", "small"),
    ("convex_maps_bwd", "small"),
    ("convolution_weight_bwd", "conv"),
    ("expectation_bwd", "small"),
    ("layer_norm_bwd", "norm"),
    ("linear_weight_bwd", "gemm"),
    ("norm_bwd", "norm"),
    ("norm_sums_bwd", "norm"),
    ("resize_bwd", "resize"),
    ("select_rows_bwd", "moves"),
    ("sum_parts", "sums"),
];

/// Returns name and value of every constant of kernels/shared/abi.wgsl.
fn constants() -> BTreeMap<&'static str, f64> {
    macro_rules! same {
        ($($name:ident),* $(,)?) => { [$((stringify!($name), f64::from(abi::$name as f32))),*] };
    }
    let mut all = BTreeMap::from(same!(
        AREA_EPS,
        AREA_RULE_OPACITY_MAX,
        OPACITY_CEILING,
        RELATIVE_AREA_MIN,
        ALPHA_MIN,
        ALPHA_MIN_LOG2,
        DISCRIMINANT_MIN_MVSPLAT,
        RADIUS_SIGMAS_MVSPLAT,
        SUPPORT_SLACK,
        SPAN_SLACK_PX,
        OPACITY_MAX,
        TILE_GPU,
        FOOTPRINT_STRIDE,
        PAIR_SUMS,
        GPU_BLOCK,
        PLAN_COUNT,
        PLAN_BLOCKS,
        PLAN_REQUESTED,
        PLAN_ELEMENT_GROUPS,
    ));
    let rules = [
        ("RULE_LINEAR", OpacityRule::Linear),
        ("RULE_OPTICAL_DEPTH", OpacityRule::OpticalDepth),
        ("RULE_TRANSMITTANCE", OpacityRule::Transmittance),
        ("RULE_AREA", OpacityRule::Area),
        ("RULE_NONE", OpacityRule::None),
    ];
    all.extend(same!(GATHER_SAMPLES_MAX, GATHER_WEIGHTS_MAX, SWEEP_PAIR_STRIDE));
    all.extend(same!(SPLAT_STRIDE, MEAN_OFFSET, QUAT_OFFSET, SCALE_OFFSET, OPACITY_OFFSET));
    all.extend(same!(
        HEAD_STRIDE,
        HEAD_UV_OFFSET,
        HEAD_DEPTH_OFFSET,
        HEAD_LOG_SCALE_OFFSET,
        HEAD_ROTATION_OFFSET
    ));
    all.extend(same!(
        HEAD_LOGIT_OFFSET,
        HEAD_GAIN_OFFSET,
        NONE,
        SPGR_CAMERA_STRIDE,
        AREA_SQ_EPS,
        GROWTH_MAX
    ));
    all.extend(same!(DEPTH_FRACTION_MIN, DISC_AREA_SQ_MIN, VISIBLE_Z_MIN));
    all.extend(rules.map(|(name, rule)| (name, f64::from(rule as u32))));
    all
}

/// Name, size, and fields with offsets of a uniform.
type Uniform = (&'static str, usize, &'static [(&'static str, usize)]);

macro_rules! uniforms {
    ($($name:ident),* $(,)?) => { &[$((stringify!($name), size_of::<$name>(), $name::FIELDS)),*] };
}

const UNIFORMS: &[Uniform] = uniforms!(
    AdamUniform,
    AdapterUniform,
    AttentionGatherUniform,
    AttentionUniform,
    AttributesUniform,
    ConvexUniform,
    ConvolutionUniform,
    CrossCheckUniform,
    DepthConsensusUniform,
    ElementwiseUniform,
    ExpectationUniform,
    HeadOutputUniform,
    InvertUniform,
    LinearUniform,
    LinearWeightBwdUniform,
    OcclusionUniform,
    NormUniform,
    PlaneSweepUniform,
    RasterUniform,
    RawMatchingUniform,
    RedistributeUniform,
    ReduceUniform,
    ResizeUniform,
    RowsUniform,
    SelectUniform,
    ShowUniform,
    SortUniform,
    SpgrGainsBwdUniform,
    SpgrUniform,
    SumPartsUniform
);

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn parse(source: &str) -> Result<Module, String> {
    naga::front::wgsl::parse_str(source).map_err(|e| e.emit_to_string(source))
}

/// Returns the sources of a kernel, and what each needs of a device.
fn sources(kernel: &Kernel) -> impl Iterator<Item = (&'static str, Capabilities)> {
    let plain = (kernel.source.plain, Capabilities::empty());
    let subgroups = kernel.source.subgroups.map(|source| (source, Capabilities::SUBGROUP));
    std::iter::once(plain).chain(subgroups)
}

fn validate(source: &str, capabilities: Capabilities) -> Result<Module, String> {
    let module = parse(source)?;
    let mut validator = Validator::new(ValidationFlags::all(), capabilities);
    validator.validate(&module).map_err(|e| e.emit_to_string(source))?;
    Ok(module)
}

fn value(module: &Module, init: Handle<Expression>) -> f64 {
    match module.global_expressions[init] {
        Expression::Literal(Literal::F32(v)) => f64::from(v),
        Expression::Literal(Literal::U32(v)) => f64::from(v),
        Expression::Literal(Literal::I32(v)) => f64::from(v),
        Expression::Literal(Literal::AbstractInt(v)) => v as f64,
        Expression::Literal(Literal::AbstractFloat(v)) => v,
        ref other => panic!("a constant that is not a number: {other:?}"),
    }
}

/// Returns the differences between the constants of `module` and those of `abi`.
fn constant_differences(module: &Module) -> Vec<String> {
    let mut ours = constants();
    let mut wrong = Vec::new();
    for (_, c) in module.constants.iter() {
        let name = c.name.clone().unwrap();
        let theirs = value(module, c.init);
        match ours.remove(name.as_str()) {
            Some(v) if v as f32 == theirs as f32 => {}
            Some(v) => wrong.push(format!("{name}: {v} in Rust, {theirs} in WGSL")),
            None => wrong.push(format!("{name} is not in this test's table")),
        }
    }
    wrong.extend(ours.keys().map(|name| format!("{name} is not in abi.wgsl")));
    wrong
}

#[test]
fn constants_match_abi() {
    let text = fs::read_to_string(root().join("kernels/shared/abi.wgsl")).unwrap();
    assert_eq!(constant_differences(&parse(&text).unwrap()), Vec::<String>::new());
    let changed = text.replace("0.9999;", "0.999;");
    assert_eq!(
        constant_differences(&parse(&changed).unwrap()).len(),
        1,
        "a changed constant passes"
    );
    let named = text.replace("const AREA_EPS", "const AREA_EPSILON");
    assert_eq!(constant_differences(&parse(&named).unwrap()).len(), 2, "a renamed constant passes");
}

/// Returns the differences between the uniforms of `module` and those of `abi`, and the names
/// compared.
fn uniform_differences(module: &Module) -> (Vec<String>, BTreeSet<String>) {
    let (mut wrong, mut seen) = (Vec::new(), BTreeSet::new());
    for (_, variable) in module.global_variables.iter() {
        if variable.space != AddressSpace::Uniform {
            continue;
        }
        let ty = &module.types[variable.ty];
        let name = ty.name.clone().unwrap_or_default();
        let TypeInner::Struct { members, span } = &ty.inner else {
            wrong.push(format!("uniform {:?} is not a struct", variable.name));
            continue;
        };
        let Some((_, size, fields)) = UNIFORMS.iter().find(|(n, ..)| *n == name) else {
            wrong.push(format!("uniform {name} is not in this test's table"));
            continue;
        };
        let theirs: Vec<_> =
            members.iter().map(|m| (m.name.as_deref().unwrap(), m.offset as usize)).collect();
        if theirs != *fields || *span as usize != *size {
            wrong.push(format!("{name}: {fields:?}, {size} bytes; WGSL {theirs:?}, {span}"));
        }
        seen.insert(name);
    }
    (wrong, seen)
}

#[test]
fn uniforms_match_abi() {
    let mut seen = BTreeSet::new();
    for kernel in KERNELS {
        let (wrong, names) = uniform_differences(&parse(kernel.source.plain).unwrap());
        assert_eq!(wrong, Vec::<String>::new(), "{}", kernel.name);
        seen.extend(names);
    }
    let all: BTreeSet<String> = UNIFORMS.iter().map(|(name, ..)| (*name).to_owned()).collect();
    assert_eq!(seen, all, "a uniform of the table belongs to no kernel");
    let redistribute = KERNELS.iter().find(|k| k.name == "redistribute").unwrap();
    let swapped = redistribute
        .source
        .plain
        .replace("parents: u32,\n    children: u32,", "children: u32, parents: u32,");
    assert_ne!(swapped, redistribute.source.plain);
    assert_eq!(uniform_differences(&parse(&swapped).unwrap()).0.len(), 1, "swapped fields pass");
}

/// Returns the access of a module's arguments, by binding.
fn arguments(module: &Module) -> BTreeMap<u32, Access> {
    let variables = module.global_variables.iter();
    variables
        .filter_map(|(_, v)| {
            let binding = v.binding.as_ref()?;
            assert_eq!(binding.group, 0, "{:?}: group 0 alone is used", v.name);
            let access = match v.space {
                AddressSpace::Uniform => Access::Uniform,
                AddressSpace::Storage { access } if access.contains(StorageAccess::STORE) => {
                    Access::Write
                }
                AddressSpace::Storage { .. } => Access::Read,
                other => panic!("{:?} in {other:?}", v.name),
            };
            Some((binding.binding, access))
        })
        .collect()
}

/// Returns the threads and the bytes of a kernel's workgroup.
fn workgroup(kernel: &Kernel, module: &Module) -> (u32, u32) {
    let entry = module.entry_points.iter().find(|e| e.name == kernel.entry);
    let entry = entry.unwrap_or_else(|| panic!("{}: no entry {}", kernel.name, kernel.entry));
    let mut layouter = Layouter::default();
    layouter.update(module.to_ctx()).unwrap();
    let variables = module.global_variables.iter().map(|(_, v)| v);
    let shared = variables.filter(|v| v.space == AddressSpace::WorkGroup);
    (entry.workgroup_size.iter().product(), shared.map(|v| layouter[v.ty].size).sum())
}

fn check_kernel(kernel: &Kernel) {
    let name = kernel.name;
    for (source, capabilities) in sources(kernel) {
        let module = validate(source, capabilities).unwrap_or_else(|e| panic!("{name}: {e}"));
        let ours: BTreeMap<u32, Access> = (0..).zip(kernel.bindings.iter().copied()).collect();
        assert_eq!(arguments(&module), ours, "{name}: arguments");
        let storage = kernel.bindings.iter().filter(|a| **a != Access::Uniform).count();
        assert!(storage <= STORAGE_MAX, "{name}: {storage} storage buffers");
        let (threads, bytes) = workgroup(kernel, &module);
        assert!(threads <= THREADS_MAX, "{name}: {threads} threads");
        assert!(bytes <= WORKGROUP_BYTES_MAX, "{name}: {bytes} bytes of workgroup memory");
    }
}

/// Stages of the table in kernels/src/gpu/mod.rs, and their largest kernel.
const STAGES: &[(&str, &str)] = &[
    ("project", "project"),
    ("sort by depth", "sort_scatter"),
    ("prefix sum, plan", "scan_apply"),
    ("intersect", "intersect"),
    ("sort by tile", "sort_count"),
    ("ranges", "ranges"),
    ("rasterize", "rasterize"),
    ("rasterize backward", "rasterize_bwd"),
    ("sum pairs", "pair_sums"),
    ("project backward", "project_bwd"),
];

/// Returns the stages of the table in `docs` whose threads, bytes, or concurrent workgroups on
/// two kinds of core differ from those of the kernel.
fn stage_differences(docs: &str) -> Vec<&'static str> {
    let cells = |line: &str| line.split('|').map(|c| c.trim().to_owned()).collect::<Vec<_>>();
    let rows: Vec<_> = docs.lines().map(cells).filter(|c| c.len() == 8).collect();
    let wrong = |(stage, name): &(&str, &str)| {
        let kernel = KERNELS.iter().find(|k| k.name == *name).unwrap();
        let (threads, bytes) = workgroup(kernel, &parse(kernel.source.plain).unwrap());
        let concurrent = |most: u32, memory: u32| (most / threads).min(memory / bytes.max(1));
        let expected = [
            threads.to_string(),
            bytes.to_string(),
            format!("{}, {}", concurrent(1024, 32 << 10), concurrent(2048, 100 << 10)),
        ];
        let found = rows.iter().find(|row| row[1] == *stage);
        !found.is_some_and(|row| {
            [row[3].clone(), row[4].replace(',', ""), row[5].clone()] == expected
        })
    };
    STAGES.iter().filter(|s| wrong(s)).map(|s| s.0).collect()
}

#[test]
fn the_table_of_stages_matches_the_kernels() {
    let docs = fs::read_to_string(root().join("kernels/src/gpu/mod.rs")).unwrap();
    assert_eq!(stage_differences(&docs), Vec::<&str>::new());
    assert_eq!(stage_differences(&docs.replace("15,368", "15,372")), ["rasterize backward"]);
    assert_eq!(
        stage_differences(&docs.replace("| 3, 8 | 160 N", "| 4, 8 | 160 N")),
        ["sort by depth"]
    );
}

#[test]
fn every_kernel_is_valid_and_within_the_default_limits() {
    assert!(!KERNELS.is_empty());
    for kernel in KERNELS {
        check_kernel(kernel);
    }
    let none = Capabilities::empty();
    assert!(validate("fn f() -> f32 { return 1u; }", none).is_err(), "naga accepts invalid WGSL");
}

/// No device without subgroup operations compiles a kernel that needs them, and the other source of such a
/// kernel uses them.
#[test]
fn subgroup_operations_are_in_their_own_source() {
    let both: Vec<_> = KERNELS.iter().filter(|k| k.source.subgroups.is_some()).collect();
    assert!(!both.is_empty());
    for kernel in both {
        for (source, needs) in sources(kernel) {
            let without = validate(source, Capabilities::empty());
            assert_eq!(without.is_err(), needs == Capabilities::SUBGROUP, "{}", kernel.name);
        }
    }
}

/// Returns the stems of the files of a folder with this extension.
fn stems(folder: &str, extension: &str) -> BTreeSet<String> {
    let files = fs::read_dir(root().join(folder)).unwrap().map(|e| e.unwrap().path());
    files
        .filter(|p| p.extension().is_some_and(|e| e == extension))
        .map(|p| p.file_stem().unwrap().to_string_lossy().into_owned())
        .collect()
}

/// Returns the kernels without a Rust side or without a CPU version.
fn orphans(kernels: &BTreeSet<String>) -> Vec<String> {
    let used: BTreeSet<&str> = KERNELS.iter().map(|k| k.name).collect();
    let mut cpu = stems("src/cpu", "rs");
    let folders = fs::read_dir(root().join("src/cpu")).unwrap().map(|e| e.unwrap().path());
    cpu.extend(
        folders
            .filter(|p| p.is_dir())
            .map(|p| p.file_name().unwrap().to_string_lossy().into_owned()),
    );
    let has_cpu_version = |stem: &str| {
        let other = CPU_STEMS.iter().find(|(kernel, _)| *kernel == stem);
        cpu.contains(other.map_or(stem, |(_, cpu_stem)| *cpu_stem))
    };
    kernels.iter().filter(|k| !used.contains(k.as_str()) || !has_cpu_version(k)).cloned().collect()
}

#[test]
fn every_kernel_has_a_cpu_version() {
    let mut kernels = stems("kernels", "wgsl");
    assert_eq!(orphans(&kernels), Vec::<String>::new());
    for kernel in KERNELS {
        assert!(kernels.contains(kernel.name), "kernels/{}.wgsl is missing", kernel.name);
    }
    kernels.insert("stray".to_owned());
    assert_eq!(orphans(&kernels), ["stray"]);
}

/// Kernels contain whole files: each file of kernels/shared is part of some kernel.
#[test]
fn shared_files_are_used() {
    for stem in stems("kernels/shared", "wgsl") {
        let text = fs::read_to_string(root().join(format!("kernels/shared/{stem}.wgsl"))).unwrap();
        assert!(
            KERNELS.iter().any(|k| sources(k).any(|(source, _)| source.contains(&text))),
            "shared/{stem}.wgsl"
        );
    }
}
