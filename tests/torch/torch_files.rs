//! PyTorch's files: those of PyTorch itself (tests/goldens/torch, made by
//! tools/make_torch_fixtures.py) and those of these tests' own writer.

use subsplat_test_support as common;
use subsplat_test_support::torch_writer as writer;

use common::shared;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use subsplat::files::weights::torch::{Form, TorchDtype, TorchFile, Value};
use writer::*;

fn goldens() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/torch")
}

fn golden(name: &str) -> TorchFile {
    TorchFile::open(goldens().join(name)).unwrap()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// The value at a dotted path; keys may hold dots themselves.
fn at<'a>(value: &'a Value, path: &str) -> Option<&'a Value> {
    if path.is_empty() {
        return Some(value);
    }
    let below = |key: &str| -> Option<String> {
        let rest = path.strip_prefix(key)?;
        if rest.is_empty() {
            Some(String::new())
        } else {
            rest.strip_prefix('.').map(str::to_owned)
        }
    };
    if let Some(items) = value.items() {
        return items.iter().enumerate().find_map(|(i, v)| at(v, &below(&i.to_string())?));
    }
    value.entries().find_map(|(k, v)| {
        let key = k.as_str().map(str::to_owned).or(k.as_int().map(|i| i.to_string()))?;
        at(v, &below(&key)?)
    })
}

/// The reader returns everything that PyTorch lists: elements, shapes, plain values.
#[test]
fn what_pytorch_wrote_is_what_is_read() {
    let text = std::fs::read_to_string(goldens().join("expected.json")).unwrap();
    let all: serde_json::Value = serde_json::from_str(&text).unwrap();
    let (mut tensors, mut plain) = (0, 0);
    for (name, values) in all.as_object().unwrap() {
        let file = golden(name);
        assert_eq!(file.form() == Form::Legacy, name.contains("legacy"), "{name}");
        for (path, want) in values.as_object().unwrap() {
            let place = format!("{name} {path}");
            // A NumPy scalar is a float to Python and opaque here.
            if path == "numpy" {
                continue;
            }
            let got = at(file.root(), path).unwrap_or_else(|| panic!("{place} is absent"));
            if let Some(want) = want.as_array() {
                let t = got.as_tensor().unwrap_or_else(|| panic!("{place}: {got:?}"));
                let shape: Vec<usize> = want[1]
                    .as_array()
                    .unwrap()
                    .iter()
                    .map(|s| s.as_u64().unwrap() as usize)
                    .collect();
                assert_eq!(
                    (t.dtype.name(), &t.shape),
                    (want[0].as_str().unwrap(), &shape),
                    "{place}"
                );
                assert_eq!(t.requires_grad, want[2].as_bool().unwrap(), "{place}");
                assert_eq!(hex(&file.read(t).unwrap()), want[3].as_str().unwrap(), "{place}");
                tensors += 1;
            } else {
                let same = match want {
                    serde_json::Value::Null => *got == Value::None,
                    serde_json::Value::Bool(b) => got.as_bool() == Some(*b),
                    serde_json::Value::String(s) => match got {
                        Value::BigInt(bytes) => {
                            s == "1208925819614629174706176" && bytes.len() == 11
                        }
                        other => other.as_str() == Some(s),
                    },
                    number => got.as_float() == number.as_f64(),
                };
                assert!(same, "{place}: {got:?} for {want}");
                plain += 1;
            }
        }
    }
    assert!(tensors > 120 && plain > 100, "{tensors} tensors, {plain} plain values");
}

#[test]
fn plain_containers_are_understood_and_objects_are_not() {
    for name in [
        "protocol2.pt",
        "protocol3.pt",
        "protocol4.pt",
        "protocol5.pt",
        "protocol2_legacy.pt",
        "protocol4_legacy.pt",
    ] {
        let file = golden(name);
        let root = file.root();
        assert_eq!(root.get("bytes"), Some(&Value::Bytes([0, 255][..].into())), "{name}");
        assert_eq!(root.get("array"), Some(&Value::Bytes(b"ab"[..].into())), "{name}");
        assert_eq!(root.get("set"), Some(&Value::Set(vec![Value::Int(3)])), "{name}");
        assert_eq!(root.get("frozen"), Some(&Value::Set(vec![Value::Str("f".into())])), "{name}");
        let opaque = |key: &str| match root.get(key) {
            Some(Value::Opaque(name)) => name.to_string(),
            other => panic!("{name} {key}: {other:?}"),
        };
        assert_eq!(opaque("callback"), "__main__.Callback", "{name}");
        assert_eq!(opaque("dtype"), "torch.float16", "{name}");
        assert!(opaque("numpy").starts_with("numpy"), "{name}");
        let met: Vec<&str> = file.opaque_globals().iter().map(String::as_str).collect();
        assert!(met.contains(&"__main__.Callback"), "{met:?}");
        assert!(
            met.iter().all(|n| !n.starts_with("torch") && !n.contains("OrderedDict")),
            "{met:?}"
        );
    }
}

#[test]
fn views_share_their_storage_and_keep_their_strides() {
    for name in ["views.pt", "views_legacy.pt"] {
        let file = golden(name);
        let get = |key: &str| file.root().get(key).unwrap().as_tensor().unwrap().clone();
        assert_eq!(get("base").storage, get("diagonal").storage, "{name}");
        assert_ne!(get("base").storage, get("unfolded").storage, "{name}");
        assert_eq!(get("transposed").strides, [1, 6], "{name}");
        assert_eq!(get("expanded").strides, [6, 0], "{name}");
        assert_eq!(get("sliced").offset, 6, "{name}");
        assert_eq!(get("scalar").shape, [0usize; 0], "{name}");
    }
}

/// Each tensor that cannot be read stands under the name of what it is; the one beside
/// them is read.
#[test]
fn tensors_that_are_not_plain_are_opaque_by_name() {
    let file = golden("refused.pt");
    for (key, word) in [
        ("complex", "torch.ComplexFloatStorage"),
        ("quantized", "_rebuild_qtensor"),
        ("sparse", "_rebuild_sparse_tensor"),
        ("uint16", "torch.uint16"),
        ("float8", "torch.float8_e4m3fn"),
        ("meta", "_rebuild_meta_tensor_no_storage"),
        ("negated", "metadata"),
        ("storage", "torch.storage"),
    ] {
        match file.root().get(key) {
            Some(Value::Opaque(name)) => assert!(name.contains(word), "{key}: {name}"),
            other => panic!("{key}: {other:?}"),
        }
    }
    let good = file.root().get("good").unwrap().as_tensor().unwrap();
    assert_eq!(file.read(good).unwrap(), [0f32, 1.0, 2.0].map(f32::to_le_bytes).concat());
}

/// The checkpoint of PyTorch Lightning: storages tagged cuda:0, `_metadata`, loops,
/// callbacks, optimizer states. Its weights are those of the safetensors file, bit for bit.
#[test]
fn the_lightning_checkpoint_holds_the_reference_weights() {
    let Some(path) = shared("golden/mvsplat_lightning_partial.ckpt") else { return };
    let Some(weights) = shared("golden/mvsplat_weights.safetensors") else { return };
    let file = TorchFile::open(&path).unwrap();
    assert_eq!(file.form(), Form::Zip);
    assert!(file.opaque_globals().is_empty(), "{:?}", file.opaque_globals());
    let bytes = std::fs::read(weights).unwrap();
    let weights = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let mut names = BTreeSet::new();
    for (key, value) in file.root().get("state_dict").unwrap().entries() {
        let (name, t) = (key.as_str().unwrap(), value.as_tensor().unwrap());
        let want = weights.tensor(name).unwrap_or_else(|_| panic!("{name} is no weight"));
        assert_eq!((t.dtype, t.shape.as_slice()), (TorchDtype::F32, want.shape()), "{name}");
        assert!(file.read(t).unwrap() == want.data(), "{name} differs");
        names.insert(name);
    }
    assert_eq!(names.len(), 137);
    assert!(file.root().get("global_step").unwrap().as_int().is_some());
    assert!(file.root().get("optimizer_states").unwrap().items().is_some());
}

/// Entries behind 4 GiB, in a file of holes.
#[test]
fn a_tensor_beyond_four_gibibytes_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("large.pt");
    let hole = (4u64 << 30) + 4096;
    let big = storage("torch FloatStorage", "0", (hole / 4) as i64);
    let root = dict(vec![
        ("row", tensor(big.clone(), (hole / 4 - 3) as i64, &[3], &[1])),
        ("column", tensor(big, 1, &[2], &[1 << 29])),
        ("last", tensor(storage("torch ShortStorage", "1", 2), 0, &[2], &[1])),
    ]);
    let mut entries = Checkpoint::default().entries(&root);
    let hole = Entry { data: Data::Hole(hole), crc: 0, ..entry("archive/data/0", &[]) };
    entries.extend([hole, entry("archive/data/1", &[1, 0, 2, 0])]);
    write_zip(&mut std::fs::File::create(&path).unwrap(), &entries).unwrap();
    let file = TorchFile::open(&path).unwrap();
    let read = |key: &str| file.read(file.root().get(key).unwrap().as_tensor().unwrap()).unwrap();
    assert_eq!(read("last"), [1, 0, 2, 0]);
    assert_eq!((read("row"), read("column")), (vec![0; 12], vec![0; 8]));
}

/// A view whose elements lie far apart in a storage too large to take whole: an
/// independent sum of index times stride gives the expected elements.
#[test]
fn wide_views_are_gathered_in_pages() {
    let count = 6 << 20;
    let mut checkpoint = Checkpoint::default();
    let bytes: Vec<u8> = (0..count as u32).flat_map(u32::to_le_bytes).collect();
    let whole = checkpoint.tensor("torch IntStorage", &bytes, &[count]);
    let view = |offset, shape: &[i64], strides: &[i64]| {
        tensor(storage("torch IntStorage", "0", count as i64), offset, shape, strides)
    };
    let root = dict(vec![
        ("whole", whole),
        ("wide", view(5, &[3, 7, 2], &[11, 800_003, 2_000_001 / 3])),
        ("rows", view(9, &[4, 2, 3], &[1_500_000, 600, 1])),
    ]);
    let file = TorchFile::parse(checkpoint.file(&root), Path::new("wide.pt")).unwrap();
    for key in ["wide", "rows"] {
        let t = file.root().get(key).unwrap().as_tensor().unwrap();
        let mut want = Vec::new();
        for i in 0..t.shape[0] {
            for j in 0..t.shape[1] {
                for k in 0..t.shape[2] {
                    let at = t.offset + i * t.strides[0] + j * t.strides[1] + k * t.strides[2];
                    want.extend((at as u32).to_le_bytes());
                }
            }
        }
        assert!(file.read(t).unwrap() == want, "{key}");
    }
    let t = file.root().get("whole").unwrap().as_tensor().unwrap();
    assert!(file.read(t).unwrap() == bytes);
}

/// A fault in a caller's own view is an error too.
#[test]
fn a_view_that_a_caller_changed_is_checked_again() {
    let file = golden("views.pt");
    let base = file.root().get("base").unwrap().as_tensor().unwrap();
    let mut beyond = base.clone();
    beyond.offset = 1;
    assert!(file.read(&beyond).unwrap_err().to_string().contains("inside its storage"));
    beyond.offset = usize::MAX;
    beyond.strides = vec![usize::MAX, 1];
    assert!(file.read(&beyond).unwrap_err().to_string().contains("inside its storage"));
    beyond.strides = vec![1];
    assert!(file.read(&beyond).unwrap_err().to_string().contains("inside its storage"));
}
