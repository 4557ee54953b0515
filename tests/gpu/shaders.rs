//! Checks of the WGSL kernels without a GPU. naga validates every kernel, and agrees with the crate
//! about arguments, uniforms and constants; kernels respect WebGPU's default limits; every file
//! belongs to a kernel and names its CPU version.

use naga::proc::Layouter;
use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{AddressSpace, Expression, Handle, Literal, Module, StorageAccess};
use std::fs;
use std::path::{Path, PathBuf};
use subsplat_kernels::gpu::{Access, KERNELS, Kernel, PAIR_SUMS};
use subsplat_kernels::layout::{ALPHA_MIN, AREA_SQ_EPS, OPACITY_MAX, OpacityRule};

/// WebGPU's default limits: storage buffers per stage, threads and bytes per workgroup.
const STORAGE_MAX: usize = 8;
const THREADS_MAX: u32 = 256;
const WORKGROUP_BYTES_MAX: u32 = 16 << 10;

/// Folders of the Rust kernels (`cpu`, `gpu`) and of the WGSL (`wgsl`).
const RUST: &str = "kernels/src";
const WGSL: &str = "kernels";

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn parse(source: &str) -> Result<Module, String> {
    naga::front::wgsl::parse_str(source).map_err(|e| e.emit_to_string(source))
}

fn validate(source: &str, capabilities: Capabilities) -> Result<Module, String> {
    let module = parse(source)?;
    let mut validator = Validator::new(ValidationFlags::all(), capabilities);
    validator.validate(&module).map_err(|e| e.emit_to_string(source))?;
    Ok(module)
}

fn kernel(name: &str) -> &'static Kernel {
    KERNELS.iter().find(|kernel| kernel.name == name).unwrap()
}

/// Returns without and with subgroup operations: whether the source is for devices that have them,
/// and what it needs of a device. Most kernels have one source.
fn variants(kernel: &Kernel) -> Vec<(bool, Capabilities)> {
    let mut all = vec![(false, Capabilities::empty())];
    if kernel.source.subgroups.is_some() {
        all.push((true, Capabilities::SUBGROUP));
    }
    all
}

/// Returns binding and access of a module's arguments, in the order of their bindings.
fn arguments(module: &Module) -> Vec<(u32, Access)> {
    let argument = |(_, variable): (_, &naga::GlobalVariable)| {
        let binding = variable.binding.as_ref()?;
        assert_eq!(binding.group, 0, "{:?}: group 0 alone is used", variable.name);
        let access = match variable.space {
            AddressSpace::Uniform => Access::Uniform,
            AddressSpace::Storage { access } if access.contains(StorageAccess::STORE) => {
                Access::Write
            }
            AddressSpace::Storage { .. } => Access::Read,
            other => panic!("{:?} in {other:?}", variable.name),
        };
        Some((binding.binding, access))
    };
    let mut all: Vec<_> = module.global_variables.iter().filter_map(argument).collect();
    all.sort_by_key(|(binding, _)| *binding);
    all
}

/// Returns name and size of a module's uniform.
fn uniform(module: &Module) -> Option<(String, usize)> {
    let mut variables = module.global_variables.iter().map(|(_, variable)| variable);
    let variable = variables.find(|variable| variable.space == AddressSpace::Uniform)?;
    let ty = &module.types[variable.ty];
    Some((ty.name.clone().unwrap_or_default(), ty.inner.size(module.to_ctx()) as usize))
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

#[test]
fn every_kernel_is_valid_and_within_the_default_limits() {
    assert!(!KERNELS.is_empty());
    for kernel in KERNELS {
        let name = kernel.name;
        for (subgroups, capabilities) in variants(kernel) {
            let source = kernel.source.text(subgroups);
            let module = validate(&source, capabilities).unwrap_or_else(|e| panic!("{name}: {e}"));
            let (threads, bytes) = workgroup(kernel, &module);
            assert!(threads <= THREADS_MAX, "{name}: {threads} threads");
            assert!(bytes <= WORKGROUP_BYTES_MAX, "{name}: {bytes} bytes of workgroup memory");
        }
    }
    let none = Capabilities::empty();
    assert!(validate("fn f() -> f32 { return 1u; }", none).is_err(), "naga accepts invalid WGSL");
}

/// The declarations that the bind group layouts are made of are those that naga finds, and binding
/// i is argument i.
#[test]
fn arguments_are_those_that_naga_finds() {
    for kernel in KERNELS {
        for (subgroups, _) in variants(kernel) {
            let naga = arguments(&parse(&kernel.source.text(subgroups)).unwrap());
            let mut ours = kernel.source.bindings(subgroups);
            ours.sort_by_key(|(binding, _)| *binding);
            assert_eq!(ours, naga, "{}", kernel.name);
            let numbers: Vec<_> = ours.iter().map(|(binding, _)| *binding as usize).collect();
            assert_eq!(numbers, (0..ours.len()).collect::<Vec<_>>(), "{}", kernel.name);
            let storage = ours.iter().filter(|(_, access)| *access != Access::Uniform).count();
            assert!(storage <= STORAGE_MAX, "{}: {storage} storage buffers", kernel.name);
        }
    }
    let adam = kernel("adam").source.bindings(false);
    assert_eq!(adam.len(), 8);
    assert_eq!(adam[0], (0, Access::Uniform));
    assert_eq!(adam[1], (1, Access::Read));
    assert_eq!(adam[7], (7, Access::Write));
}

/// The compiler checks offsets where a uniform is declared; naga's size includes the last field's end.
#[test]
fn uniforms_have_the_size_that_naga_finds() {
    for kernel in KERNELS {
        let ours = kernel.source.uniform.map(|ours| (ours.name.to_owned(), ours.bytes));
        assert_eq!(uniform(&parse(&kernel.source.text(false)).unwrap()), ours, "{}", kernel.name);
    }
}

fn value(module: &Module, init: Handle<Expression>) -> f64 {
    match module.global_expressions[init] {
        Expression::Literal(Literal::F32(v)) => f64::from(v),
        Expression::Literal(Literal::U32(v)) => f64::from(v),
        ref other => panic!("a constant that is not a number: {other:?}"),
    }
}

/// naga reads the digits of the constants as the same numbers, at the ends of both ranges too.
#[test]
fn constants_have_the_values_of_rust() {
    let module = parse(&kernel("scan_whole").source.text(false)).unwrap();
    let constant = |name: &str| {
        let mut all = module.constants.iter().map(|(_, constant)| constant);
        value(&module, all.find(|constant| constant.name.as_deref() == Some(name)).unwrap().init)
    };
    assert_eq!(constant("ALPHA_MIN"), f64::from(ALPHA_MIN));
    assert_eq!(constant("AREA_SQ_EPS"), f64::from(AREA_SQ_EPS as f32));
    assert_eq!(constant("OPACITY_MAX"), f64::from(OPACITY_MAX));
    assert_eq!(constant("NONE"), f64::from(u32::MAX));
    assert_eq!(constant("PAIR_SUMS"), PAIR_SUMS as f64);
    assert_eq!(constant("RULE_AREA"), f64::from(OpacityRule::Area as u32));
}

/// No device without subgroup operations compiles a kernel that needs them, and the other source of
/// such a kernel uses them.
#[test]
fn subgroup_operations_are_in_their_own_source() {
    let both: Vec<_> = KERNELS.iter().filter(|k| k.source.subgroups.is_some()).collect();
    assert!(!both.is_empty());
    for kernel in both {
        for (subgroups, _) in variants(kernel) {
            let without = validate(&kernel.source.text(subgroups), Capabilities::empty());
            assert_eq!(without.is_err(), subgroups, "{}", kernel.name);
        }
    }
}

/// Stages of the table in gpu/mod.rs, and their largest kernel.
const STAGES: &[(&str, &str)] = &[
    ("project", "project"),
    ("sort by depth", "sort_scatter"),
    ("prefix sum, plan", "scan_apply"),
    ("intersect", "intersect"),
    ("sort by tile", "sort_count"),
    ("ranges", "ranges"),
    ("rasterize", "blend"),
    ("rasterize backward", "blend_bwd"),
    ("sum pairs", "pair_sums"),
    ("project backward", "project_bwd"),
];

/// Returns the stages of the table in `docs` whose threads, bytes, or concurrent workgroups on
/// two kinds of core differ from those of the kernel.
fn stage_differences(docs: &str) -> Vec<&'static str> {
    let cells = |line: &str| line.split('|').map(|c| c.trim().to_owned()).collect::<Vec<_>>();
    let rows: Vec<_> = docs.lines().map(cells).filter(|c| c.len() == 8).collect();
    let wrong = |(stage, name): &(&str, &str)| {
        let kernel = kernel(name);
        let (threads, bytes) = workgroup(kernel, &parse(&kernel.source.text(false)).unwrap());
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
    let docs = fs::read_to_string(root().join(RUST).join("gpu/mod.rs")).unwrap();
    assert_eq!(stage_differences(&docs), Vec::<&str>::new());
    assert_eq!(stage_differences(&docs.replace("15,368", "15,372")), ["rasterize backward"]);
    assert_eq!(
        stage_differences(&docs.replace("| 3, 8 | 160 N", "| 4, 8 | 160 N")),
        ["sort by depth"]
    );
}

/// Returns folder, stem and text of every WGSL file.
fn files() -> Vec<(String, String, String)> {
    let name = |path: &Path| path.file_stem().unwrap().to_string_lossy().into_owned();
    let entries = |path: &Path| fs::read_dir(path).unwrap().map(|e| e.unwrap().path());
    let mut all = Vec::new();
    for folder in entries(&root().join(WGSL).join("wgsl")) {
        for file in entries(&folder) {
            all.push((name(&folder), name(&file), fs::read_to_string(&file).unwrap()));
        }
    }
    all
}

/// Kernels contain whole files, and the last file of a kernel has its name.
#[test]
fn every_file_belongs_to_a_kernel() {
    for (folder, stem, text) in files() {
        let holds = |kernel: &&Kernel| {
            let all = variants(kernel);
            let mut sources = all.iter().map(|(subgroups, _)| kernel.source.files(*subgroups));
            if folder == "shared" {
                sources.any(|files| files.contains(&text.as_str()))
            } else {
                kernel.name == stem && sources.all(|files| files.last() == Some(&text.as_str()))
            }
        };
        assert!(KERNELS.iter().copied().any(|kernel| holds(&kernel)), "wgsl/{folder}/{stem}.wgsl");
    }
}

/// Returns the paths in the comments of a WGSL file that do not exist.
fn missing_paths(text: &str) -> Vec<&str> {
    let comments = text.lines().filter_map(|line| line.trim_start().strip_prefix("//"));
    let words = comments.flat_map(str::split_whitespace);
    let paths = words.map(|word| word.trim_matches(|c: char| !c.is_alphanumeric()));
    let missing = |path: &&str| match path.split('/').next() {
        Some("cpu" | "gpu") => path.contains('/') && !root().join(RUST).join(path).exists(),
        Some("wgsl") => path.contains('/') && !root().join(WGSL).join(path).exists(),
        _ => false,
    };
    paths.filter(missing).collect()
}

#[test]
fn every_kernel_names_its_cpu_version() {
    for (folder, stem, text) in files() {
        assert_eq!(missing_paths(&text), Vec::<&str>::new(), "wgsl/{folder}/{stem}.wgsl");
        let header: Vec<_> = text.lines().take_while(|line| line.starts_with("//")).collect();
        let header = header.join(" ").replace("// ", "");
        let named = header.contains("CPU version") || folder == "shared";
        assert!(named, "wgsl/{folder}/{stem}.wgsl names no CPU version");
    }
    assert_eq!(missing_paths("// CPU version: cpu/nowhere.rs."), ["cpu/nowhere.rs"]);
}
