//! Rules that a compiler does not check: the imports between modules, the places of `unsafe`,
//! printing and panics, and the names at the top level of the repository.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Each module with the modules that it may import; other imports are forbidden. A test
/// below compares this table with the one in ARCHITECTURE.md.
const IMPORTS: &[(&str, &[&str])] = &[
    ("abi", &["camera"]),
    ("clock", &[]),
    ("metrics", &[]),
    ("camera", &[]),
    ("sh", &["abi"]),
    ("config", &["abi"]),
    ("splats", &["abi", "camera", "sh"]),
    ("navigation", &["camera"]),
    ("cpu", &["abi", "camera", "clock", "sh"]),
    ("device", &[]),
    ("gpu", &["abi", "camera", "device"]),
    ("backend", &["device", "gpu"]),
    ("render", &["abi", "backend", "camera", "cpu", "gpu", "io", "splats"]),
    ("loss", &["cpu", "metrics"]),
    ("fit", &["abi", "camera", "io", "loss", "render", "splats"]),
    ("refine", &["abi", "camera", "cpu", "fit", "io", "loss", "render", "splats"]),
    ("merge", &["abi", "sh", "splats"]),
    ("levels", &["abi", "camera", "merge", "splats"]),
    ("reduce", &["abi", "camera", "fit", "io", "merge", "refine", "render", "sh", "splats"]),
    ("matches", &["cpu"]),
    ("check", &["camera", "matches", "metrics"]),
    ("poses", &["camera", "matches"]),
    ("io", &["abi", "camera", "config", "sh", "splats"]),
    ("data", &["camera", "io", "metrics", "splats"]),
    ("ops", &["abi", "backend", "camera", "cpu", "gpu", "splats"]),
    ("model", &["abi", "camera", "config", "io", "ops", "sh", "splats"]),
    (
        "pipeline",
        &[
            "abi", "camera", "check", "clock", "config", "cpu", "data", "fit", "io", "metrics",
            "model", "poses", "refine", "render", "sh", "splats",
        ],
    ),
    (
        "eval",
        &[
            "abi", "camera", "clock", "config", "cpu", "data", "fit", "io", "metrics", "model",
            "pipeline", "poses", "refine", "render", "splats",
        ],
    ),
    (
        "train",
        &[
            "abi", "camera", "clock", "config", "cpu", "data", "io", "loss", "metrics", "model",
            "ops",
        ],
    ),
];

const TOP_LEVEL: &[&str] = &[
    ".cargo",
    ".ci",
    ".git",
    ".gitignore",
    ".github",
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "Cargo.lock",
    "Cargo.toml",
    "LICENSE",
    "README.md",
    "benches",
    "clippy.toml",
    "examples",
    "kernels",
    "out",
    "rustfmt.toml",
    "src",
    "target",
    "tests",
    "tools",
];

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// First path component under `src/`, without `.rs`.
fn module(path: &Path) -> String {
    let relative = path.strip_prefix(root().join("src")).unwrap();
    let first = relative.components().next().unwrap().as_os_str().to_string_lossy().into_owned();
    first.trim_end_matches(".rs").to_owned()
}

/// Lines of code: comments, and unit tests at the end of a file, left out.
fn code(text: &str) -> String {
    let tests = ["#[cfg(test)]\nmod ", "#[cfg(test)]\npub(super) mod "];
    let end = tests.iter().filter_map(|t| text.find(t)).min().unwrap_or(text.len());
    let body = &text[..end];
    body.lines()
        .map(|l| if l.trim_start().starts_with("//") { "" } else { l })
        .collect::<Vec<_>>()
        .join("\n")
}

/// Modules that `text` names after `crate::`, in paths and in grouped imports.
fn imports(text: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let name = |s: &str| -> String {
        s.trim_start().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
    };
    for (at, _) in text.match_indices("crate::") {
        let boundary = text[..at].chars().next_back();
        if boundary.is_some_and(|c| c.is_alphanumeric() || c == '_' || c == '$') {
            continue;
        }
        let rest = &text[at + "crate::".len()..];
        match rest.strip_prefix('{') {
            None => drop(found.insert(name(rest))),
            Some(group) => {
                let (mut depth, mut start) = (0i32, true);
                for (i, c) in group.char_indices() {
                    if start && (c.is_alphabetic() || c == '_') {
                        found.insert(name(&group[i..]));
                        start = false;
                    }
                    match c {
                        '{' => depth += 1,
                        '}' if depth == 0 => break,
                        '}' => depth -= 1,
                        ',' if depth == 0 => start = true,
                        _ => {}
                    }
                }
            }
        }
    }
    found
}

fn breaches(module: &str, text: &str) -> Vec<String> {
    let known: BTreeSet<&str> = IMPORTS.iter().map(|(r, _)| *r).collect();
    let Some((_, allowed)) = IMPORTS.iter().find(|(r, _)| *r == module) else {
        return vec![format!("module `{module}` is not in the table")];
    };
    imports(&code(text))
        .into_iter()
        .filter(|i| known.contains(i.as_str()) && i != module && !allowed.contains(&i.as_str()))
        .map(|i| format!("`{module}` may not import `{i}`"))
        .collect()
}

#[test]
fn imports_are_allowed() {
    let mut wrong = Vec::new();
    let mut seen = 0;
    for path in sources(&root().join("src")) {
        let module = module(&path);
        if module == "lib" {
            continue;
        }
        let text = fs::read_to_string(&path).unwrap();
        seen += 1;
        let found = breaches(&module, &text);
        wrong.extend(found.into_iter().map(|b| format!("{}: {b}", path.display())));
    }
    assert!(seen > 8, "found only {seen} files of the library");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn the_import_check_sees_a_breach() {
    assert_eq!(breaches("cpu", "use crate::model::SubSplat;").len(), 1);
    assert_eq!(breaches("cpu", "fn f() { crate::io::read(p) }").len(), 1);
    assert_eq!(breaches("cpu", "use crate::{abi::X, model::{A, B}, camera};").len(), 1);
    assert_eq!(breaches("model", "use crate::{\n    abi::X,\n    data::{A},\n};").len(), 1);
    assert!(breaches("cpu", "use crate::{abi::{MEAN_OFFSET, camera}, camera::Camera};").is_empty());
    assert!(breaches("cpu", "// crate::model is not for us").is_empty());
    assert_eq!(breaches("unknown", "").len(), 1);
}

#[test]
fn only_the_network_uses_candle() {
    for path in sources(&root().join("src")) {
        let module = module(&path);
        if [
            "abi",
            "camera",
            "config",
            "sh",
            "cpu",
            "gpu",
            "render",
            "navigation",
            "metrics",
            "check",
            "io",
            "data",
            "loss",
            "fit",
            "refine",
            "eval",
        ]
        .contains(&module.as_str())
        {
            let text = code(&fs::read_to_string(&path).unwrap());
            assert!(!text.contains("candle"), "{} uses candle", path.display());
        }
    }
}

#[test]
fn unsafe_printing_and_panics_are_confined() {
    let mut wrong = Vec::new();
    for path in sources(&root().join("src")) {
        let module = module(&path);
        let text = code(&fs::read_to_string(&path).unwrap());
        let mut forbid = |what: &str| {
            for (i, line) in text.lines().enumerate().filter(|(_, l)| l.contains(what)) {
                wrong.push(format!("{}:{}: {}", path.display(), i + 1, line.trim()));
            }
        };
        if module != "cpu" {
            forbid("unsafe ");
        }
        for what in ["println!", "eprintln!", "process::exit"] {
            forbid(what);
        }
        for what in [".unwrap()", ".expect(", "panic!(", "todo!(", "unimplemented!("] {
            forbid(what);
        }
    }
    for path in sources(&root().join("tools/cli/src")) {
        let text = code(&fs::read_to_string(&path).unwrap());
        let mut forbidden = vec![".unwrap()", ".expect(", "panic!(", "todo!(", "unimplemented!("];
        if path.file_name().is_none_or(|n| n != "pages.rs") {
            forbidden.push("unsafe ");
        }
        for what in forbidden {
            for (i, line) in text.lines().enumerate().filter(|(_, l)| l.contains(what)) {
                wrong.push(format!("{}:{}: {}", path.display(), i + 1, line.trim()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn files_stay_readable() {
    for path in sources(&root().join("src")) {
        let lines = fs::read_to_string(&path).unwrap().lines().count();
        assert!(lines <= 800, "{} has {lines} lines: split it by meaning", path.display());
    }
}

#[test]
fn top_level_has_the_agreed_names() {
    for entry in fs::read_dir(root()).unwrap() {
        let name = entry.unwrap().file_name().to_string_lossy().into_owned();
        assert!(TOP_LEVEL.contains(&name.as_str()), "`{name}` at the top level");
    }
}

/// Paths of this repository that a text names, such as `tests/raster/raster.rs`.
fn named_paths(text: &str) -> Vec<&str> {
    let is_path = |c: char| c.is_ascii_alphanumeric() || "_/.".contains(c);
    let folders = ["benches/", "examples/", "kernels/", "src/", "tests/", "tools/"];
    let words = text.split(|c: char| !is_path(c)).map(|w| w.trim_end_matches('.'));
    words
        .filter(|w| folders.iter().any(|f| w.starts_with(f)))
        .filter(|w| [".rs", ".wgsl", ".py"].iter().any(|e| w.ends_with(e)))
        .collect()
}

#[test]
fn comments_name_files_that_exist() {
    let mut wrong = Vec::new();
    let mut seen = 0;
    for folder in ["src", "benches", "tests"] {
        for path in sources(&root().join(folder)) {
            let text = fs::read_to_string(&path).unwrap();
            let comments: Vec<&str> =
                text.lines().filter(|l| l.trim_start().starts_with("//")).collect();
            for named in comments.iter().flat_map(|l| named_paths(l)) {
                seen += 1;
                // `x.wgsl` and `NAME.rs` stand for any name.
                if !named.contains("/x.") && !named.contains("NAME") && !root().join(named).exists()
                {
                    wrong.push(format!("{}: {named}", path.display()));
                }
            }
        }
    }
    assert!(seen > 20, "found only {seen} paths");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn architecture_states_the_same_imports() {
    let text = fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    for (module, allowed) in IMPORTS {
        let list = if allowed.is_empty() { "nothing".to_owned() } else { allowed.join(", ") };
        let row = format!("| {module} | {list} |");
        assert!(text.contains(&row), "ARCHITECTURE.md lacks the row `{row}`");
    }
}
