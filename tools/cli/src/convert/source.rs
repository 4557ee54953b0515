//! An input file with weights: of `torch.save` or safetensors, as a list of names. Elements are
//! read later, one tensor at a time.

use crate::convert::numbers::Float;
use anyhow::{Context, Result, bail};
use safetensors::Dtype;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use subsplat::files as io;
use subsplat::files::weights::tensors::{TensorFile, TensorSpec};
use subsplat::files::weights::torch::{Form, TensorRef, TorchDtype, TorchFile, Value};
use subsplat::network::config::Config;

/// Keys of the state dict inside a checkpoint: Lightning's and UniMatch's.
const WRAPPERS: [&str; 2] = ["state_dict", "model"];
/// Bytes per call of the hash.
const CHUNK: usize = 1 << 16;

/// An input file.
pub struct Source {
    pub path: PathBuf,
    /// `safetensors`, `torch zip` or `torch legacy`.
    pub format: &'static str,
    /// Key of the state dict in the file: `state_dict`, `model`, or `None`.
    pub inside: Option<&'static str>,
    pub entries: Vec<Entry>,
    /// Tensors beside the state dict (optimizer state), and their bytes.
    pub beside: (usize, u64),
    /// Classes and functions that the file names; none of them was called.
    pub opaque: BTreeSet<String>,
    /// The configuration in the metadata, if there is one.
    pub config: Option<Config>,
    pub bytes: u64,
    pub sha256: String,
    reader: Reader,
}

/// An entry of the state dict.
pub struct Entry {
    pub name: String,
    pub content: Content,
}

/// Content of an entry.
pub enum Content {
    /// A tensor of floats.
    Floats { dtype: Float, shape: Vec<usize>, place: Place },
    /// A tensor of integers or bools (counters of layers), with a description.
    Integers(String),
    /// Anything else, with a description.
    Other(String),
}

/// Location of the elements.
pub enum Place {
    /// A view of a storage of the torch file.
    Torch(Arc<TensorRef>),
    /// Under the entry's own name.
    Named,
}

enum Reader {
    Torch(TorchFile),
    Safetensors(TensorFile),
}

impl Source {
    /// Opens a file; its content determines the format.
    pub fn open(path: &Path) -> Result<Self> {
        let mut source =
            if is_safetensors(path)? { Self::safetensors(path)? } else { Self::torch(path)? };
        (source.bytes, source.sha256) = hash(path)?;
        Ok(source)
    }

    /// Name of the file, without its folder.
    pub fn file_name(&self) -> String {
        self.path.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }

    /// Reads the elements of one of the entries, little-endian.
    pub fn read(&self, entry: &Entry) -> io::Result<Vec<u8>> {
        match (&self.reader, &entry.content) {
            (Reader::Torch(file), Content::Floats { place: Place::Torch(t), .. }) => file.read(t),
            (Reader::Safetensors(file), _) => file.read(&entry.name),
            _ => Err(io::Error::format(&self.path, format!("floats at `{}`", entry.name), "none")),
        }
    }

    fn safetensors(path: &Path) -> Result<Self> {
        let file = TensorFile::open(path)?;
        let config = match file.metadata(Config::METADATA_KEY) {
            Some(json) => {
                Some(Config::from_json(json).with_context(|| path.display().to_string())?)
            }
            None => None,
        };
        let entry = |TensorSpec { name, dtype, shape }: TensorSpec| {
            let content = match Float::from_dtype(dtype) {
                Some(dtype) => Content::Floats { dtype, shape, place: Place::Named },
                None => not_floats(dtype, &shape),
            };
            Entry { name, content }
        };
        let entries = file.specs().into_iter().map(entry).collect();
        let reader = Reader::Safetensors(file);
        Ok(Self { entries, config, ..Self::empty(path, "safetensors", reader) })
    }

    fn torch(path: &Path) -> Result<Self> {
        let file = TorchFile::open(path)?;
        let root = file.root();
        let inside = WRAPPERS.into_iter().find(|k| matches!(root.get(k), Some(Value::Dict(_))));
        let dict = inside.and_then(|key| root.get(key)).unwrap_or(root);
        if !matches!(dict, Value::Dict(_)) {
            let hint = match root {
                Value::Opaque(_) => " (a whole module; save its state_dict() instead)",
                _ => "",
            };
            bail!("{}: expected a state dict, got {}{hint}", path.display(), root.kind());
        }
        let entries = dict.entries().map(entry).collect();
        let (all, weights) = (tensors(root), tensors(dict));
        let beside = (all.0 - weights.0, all.1.saturating_sub(weights.1));
        let opaque = file.opaque_globals().clone();
        let format = match file.form() {
            Form::Zip => "torch zip",
            Form::Legacy => "torch legacy",
        };
        let empty = Self::empty(path, format, Reader::Torch(file));
        Ok(Self { inside, entries, beside, opaque, ..empty })
    }

    fn empty(path: &Path, format: &'static str, reader: Reader) -> Self {
        Self {
            path: path.to_owned(),
            format,
            inside: None,
            entries: Vec::new(),
            beside: (0, 0),
            opaque: BTreeSet::new(),
            config: None,
            bytes: 0,
            sha256: String::new(),
            reader,
        }
    }
}

fn entry((key, value): (&Value, &Value)) -> Entry {
    let content = match value {
        Value::Tensor(t) => match float(t.dtype) {
            Some(dtype) => {
                let place = Place::Torch(Arc::clone(t));
                Content::Floats { dtype, shape: t.shape.clone(), place }
            }
            None => Content::Integers(value.kind()),
        },
        _ => Content::Other(value.kind()),
    };
    let name = key.as_str().map_or_else(|| format!("({} as key)", key.kind()), str::to_owned);
    Entry { name, content }
}

fn not_floats(dtype: Dtype, shape: &[usize]) -> Content {
    let what = format!("a {dtype:?} tensor of shape {shape:?}");
    match dtype {
        Dtype::BOOL | Dtype::U8 | Dtype::I8 | Dtype::U16 | Dtype::I16 => Content::Integers(what),
        Dtype::U32 | Dtype::I32 | Dtype::U64 | Dtype::I64 => Content::Integers(what),
        _ => Content::Other(what),
    }
}

fn float(dtype: TorchDtype) -> Option<Float> {
    match dtype {
        TorchDtype::F64 => Some(Float::F64),
        TorchDtype::F32 => Some(Float::F32),
        TorchDtype::F16 => Some(Float::F16),
        TorchDtype::BF16 => Some(Float::Bf16),
        _ => None,
    }
}

/// Counts the tensors in `value` and their bytes. (The reader limits the depth.)
fn tensors(value: &Value) -> (usize, u64) {
    let add = |(n, b): (usize, u64), v: &Value| {
        let (more, bytes) = tensors(v);
        (n + more, b.saturating_add(bytes))
    };
    match value {
        Value::Tensor(t) => (1, (t.elements() as u64).saturating_mul(t.dtype.size() as u64)),
        Value::Dict(_) => value.entries().map(|(_, v)| v).fold((0, 0), add),
        _ => value.items().unwrap_or_default().iter().fold((0, 0), add),
    }
}

/// True if the file is safetensors: by its name, or by the JSON object after a header length of
/// at most five bytes. No file of `torch.save` has zeros and `{` there.
fn is_safetensors(path: &Path) -> Result<bool> {
    let mut head = Vec::new();
    let file = std::fs::File::open(path).with_context(|| path.display().to_string())?;
    file.take(9).read_to_end(&mut head).with_context(|| path.display().to_string())?;
    let named = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("safetensors"));
    Ok(named || head.get(5..) == Some(&[0, 0, 0, b'{']))
}

/// Computes length and SHA-256 of a file, in lower-case hexadecimal.
fn hash(path: &Path) -> Result<(u64, String)> {
    let mut file = std::fs::File::open(path).with_context(|| path.display().to_string())?;
    let mut hasher = Sha256::new();
    let mut total = 0;
    let mut chunk = vec![0; CHUNK];
    loop {
        let n = file.read(&mut chunk).with_context(|| path.display().to_string())?;
        let Some(read) = chunk.get(..n).filter(|r| !r.is_empty()) else { break };
        hasher.update(read);
        total += n as u64;
    }
    let digest = hasher.finalize();
    Ok((total, digest.iter().map(|b| format!("{b:02x}")).collect()))
}
