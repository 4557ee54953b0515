//! The house rules that a compiler does not hold: which room may import which,
//! where `unsafe`, printing and panics may stand, and what lies at the top level.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Room and the rooms it may import; what is absent is forbidden. The same table
/// stands in ARCHITECTURE.md (a test below compares them).
const ARROWS: &[(&str, &[&str])] = &[
    ("abi", &[]),
    ("metrics", &[]),
    ("camera", &[]),
    ("sh", &["abi"]),
    ("config", &["abi"]),
    ("splats", &["abi", "camera", "sh"]),
    ("view", &["abi", "camera"]),
    ("navigation", &["camera"]),
    ("cpu", &["abi", "camera", "sh", "view"]),
    ("device", &[]),
    ("gpu", &["abi", "camera", "device", "view"]),
    ("backend", &["device", "gpu"]),
    ("render", &["abi", "backend", "camera", "cpu", "gpu", "splats"]),
    ("check", &["camera", "metrics"]),
    ("io", &["abi", "camera", "config", "sh", "splats"]),
    ("data", &["camera", "io", "metrics", "splats"]),
    ("ops", &["abi", "backend", "camera", "cpu", "gpu", "splats"]),
    ("model", &["abi", "camera", "config", "io", "ops", "sh", "splats"]),
    (
        "pipeline",
        &[
            "abi", "camera", "check", "config", "cpu", "data", "io", "metrics", "model", "render",
            "sh", "splats",
        ],
    ),
    (
        "eval",
        &[
            "abi", "camera", "config", "cpu", "data", "io", "metrics", "model", "pipeline",
            "render", "splats",
        ],
    ),
    ("train", &["abi", "camera", "config", "data", "io", "metrics", "model", "ops"]),
];

const TOP_LEVEL: &[&str] = &[
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
fn room(path: &Path) -> String {
    let relative = path.strip_prefix(root().join("src")).unwrap();
    let first = relative.components().next().unwrap().as_os_str().to_string_lossy().into_owned();
    first.trim_end_matches(".rs").to_owned()
}

/// Lines of code: comments, and unit tests at the end of a file, left out.
fn code(text: &str) -> String {
    let body = text.split("#[cfg(test)]\nmod ").next().unwrap_or(text);
    body.lines()
        .map(|l| if l.trim_start().starts_with("//") { "" } else { l })
        .collect::<Vec<_>>()
        .join("\n")
}

/// Rooms that `text` names after `crate::`, in paths and in grouped imports.
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

fn breaches(room: &str, text: &str) -> Vec<String> {
    let known: BTreeSet<&str> = ARROWS.iter().map(|(r, _)| *r).collect();
    let Some((_, allowed)) = ARROWS.iter().find(|(r, _)| *r == room) else {
        return vec![format!("room `{room}` is not in the table")];
    };
    imports(&code(text))
        .into_iter()
        .filter(|i| known.contains(i.as_str()) && i != room && !allowed.contains(&i.as_str()))
        .map(|i| format!("`{room}` may not import `{i}`"))
        .collect()
}

#[test]
fn arrows_hold() {
    let mut wrong = Vec::new();
    let mut seen = 0;
    for path in sources(&root().join("src")) {
        let room = room(&path);
        if room == "lib" {
            continue;
        }
        let text = fs::read_to_string(&path).unwrap();
        seen += 1;
        let found = breaches(&room, &text);
        wrong.extend(found.into_iter().map(|b| format!("{}: {b}", path.display())));
    }
    assert!(seen > 8, "found only {seen} files of the library");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn the_arrow_check_sees_a_breach() {
    assert_eq!(breaches("cpu", "use crate::model::SubSplat;").len(), 1);
    assert_eq!(breaches("cpu", "fn f() { crate::io::read(p) }").len(), 1);
    assert_eq!(breaches("cpu", "use crate::{abi::X, model::{A, B}, camera};").len(), 1);
    assert_eq!(breaches("model", "use crate::{\n    abi::X,\n    data::{A},\n};").len(), 1);
    assert!(breaches("cpu", "use crate::{abi::{MEAN_OFFSET, camera}, camera::Camera};").is_empty());
    assert!(breaches("cpu", "// crate::model is not for us").is_empty());
    assert_eq!(breaches("attic", "").len(), 1);
}

#[test]
fn candle_stays_out_of_the_kernels() {
    for path in sources(&root().join("src")) {
        let room = room(&path);
        if [
            "abi",
            "backend",
            "camera",
            "config",
            "device",
            "sh",
            "cpu",
            "gpu",
            "render",
            "view",
            "navigation",
            "metrics",
            "check",
            "io",
            "data",
            "eval",
        ]
        .contains(&room.as_str())
        {
            let text = code(&fs::read_to_string(&path).unwrap());
            assert!(!text.contains("candle"), "{} names candle", path.display());
        }
    }
}

#[test]
fn unsafe_printing_and_panics_stay_where_they_belong() {
    let mut wrong = Vec::new();
    for path in sources(&root().join("src")) {
        let room = room(&path);
        let text = code(&fs::read_to_string(&path).unwrap());
        let mut forbid = |what: &str| {
            for (i, line) in text.lines().enumerate().filter(|(_, l)| l.contains(what)) {
                wrong.push(format!("{}:{}: {}", path.display(), i + 1, line.trim()));
            }
        };
        if room != "cpu" {
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
        assert!(lines <= 800, "{} has {lines} lines: is it one room, or two?", path.display());
    }
}

#[test]
fn top_level_is_what_was_agreed() {
    for entry in fs::read_dir(root()).unwrap() {
        let name = entry.unwrap().file_name().to_string_lossy().into_owned();
        assert!(TOP_LEVEL.contains(&name.as_str()), "`{name}` at the top level");
    }
}

#[test]
fn architecture_states_the_same_arrows() {
    let text = fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap();
    for (room, allowed) in ARROWS {
        let list = if allowed.is_empty() { "nothing".to_owned() } else { allowed.join(", ") };
        let row = format!("| {room} | {list} |");
        assert!(text.contains(&row), "ARCHITECTURE.md lacks the row `{row}`");
    }
}
