//! safetensors files one tensor at a time, for files that are larger than memory.

use crate::files::{Error, Result, open_regular, write_atomic};
use safetensors::Dtype;
use safetensors::tensor::{Metadata, TensorInfo};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// Bytes of the length in front of the header.
const LENGTH_BYTES: u64 = 8;
/// Longest header of the format, bytes.
const HEADER_MAX: u64 = 100_000_000;
/// Alignment of the data, bytes.
const ALIGNMENT: usize = 8;
/// Key of the metadata in the header; no tensor has this name.
const METADATA: &str = "__metadata__";

/// Name, element type and shape of a tensor in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TensorSpec {
    /// Its name.
    pub name: String,
    /// Element type.
    pub dtype: Dtype,
    /// Sizes, outermost first.
    pub shape: Vec<usize>,
}

impl TensorSpec {
    /// Returns the number of elements, or `None` where it exceeds `usize`.
    pub fn elements(&self) -> Option<usize> {
        self.shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d))
    }

    /// Returns the length in bytes, or `None` where it exceeds `usize`.
    pub fn bytes(&self) -> Option<usize> {
        Some(self.elements()?.checked_mul(self.dtype.bitsize())?.div_ceil(8))
    }
}

/// An open safetensors file. Its header is compared with the file's length; elements are
/// read on demand.
#[derive(Debug)]
pub struct TensorFile {
    path: PathBuf,
    header: Metadata,
    /// Position of the first element.
    data_at: u64,
}

impl TensorFile {
    /// Opens a file and reads its header.
    ///
    /// # Errors
    /// Missing, not a safetensors file, shorter or longer than the header declares.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        Self::open_at(path.as_ref())
    }

    fn open_at(path: &Path) -> Result<Self> {
        let bad = |got: String| Error::format(path, "a safetensors file", got);
        let io = |e| Error::io(path, e);
        let mut file = open_regular(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut prefix = [0; LENGTH_BYTES as usize];
        if length < LENGTH_BYTES {
            return Err(bad(format!("{length} bytes")));
        }
        file.read_exact(&mut prefix).map_err(io)?;
        let n = u64::from_le_bytes(prefix);
        if n > HEADER_MAX || n > length - LENGTH_BYTES {
            return Err(bad(format!("a header of {n} bytes in a file of {length}")));
        }
        let mut text = vec![0; usize::try_from(n).unwrap_or_default()];
        file.read_exact(&mut text).map_err(io)?;
        let header: Metadata = serde_json::from_slice(&text).map_err(|e| bad(e.to_string()))?;
        let data_at = LENGTH_BYTES + n;
        let wanted = header.data_len() as u64;
        if wanted != length - data_at {
            let got = length - data_at;
            return Err(bad(format!("{got} bytes of data where the header names {wanted}")));
        }
        Ok(Self { path: path.to_owned(), header, data_at })
    }

    /// Lists the tensors in the order of their data.
    pub fn specs(&self) -> Vec<TensorSpec> {
        let spec = |name: String| {
            let info = self.header.info(&name)?;
            Some(TensorSpec { dtype: info.dtype, shape: info.shape.clone(), name })
        };
        self.header.offset_keys().into_iter().filter_map(spec).collect()
    }

    /// Returns the metadata's value at `key`.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.header.metadata().as_ref()?.get(key).map(String::as_str)
    }

    /// Reads the elements of a tensor, little-endian, row-major.
    ///
    /// # Errors
    /// No such tensor; the file has become shorter or unreadable since it was opened.
    pub fn read(&self, name: &str) -> Result<Vec<u8>> {
        let Some(info) = self.header.info(name) else {
            return Err(Error::format(&self.path, format!("a tensor `{name}`"), "none"));
        };
        let (start, end) = info.data_offsets;
        let io = |e| Error::io(&self.path, e);
        let mut file = File::open(&self.path).map_err(io)?;
        file.seek(SeekFrom::Start(self.data_at + start as u64)).map_err(io)?;
        let mut bytes = vec![0; end - start];
        file.read_exact(&mut bytes).map_err(io)?;
        Ok(bytes)
    }
}

/// Writes a safetensors file atomically. `data` returns the elements of the tensor at an
/// index of `specs`, little-endian. It is called once for each index in order, so that one
/// tensor is in memory at a time.
///
/// # Errors
/// Two tensors of one name, data whose length does not match the shape, errors of `data`
/// and of [`write_atomic`].
pub fn write_tensors(
    path: impl AsRef<Path>,
    specs: &[TensorSpec],
    metadata: &BTreeMap<String, String>,
    mut data: impl FnMut(usize) -> Result<Vec<u8>>,
) -> Result<()> {
    let path = path.as_ref();
    let header = header(path, specs, metadata)?;
    let mut refused = None;
    let written = write_atomic(path, |out| {
        out.write_all(&(header.len() as u64).to_le_bytes())?;
        out.write_all(&header)?;
        for (i, spec) in specs.iter().enumerate() {
            let bytes = data(i).and_then(|bytes| {
                if spec.bytes() == Some(bytes.len()) {
                    Ok(bytes)
                } else {
                    Err(wrong_length(path, spec, bytes.len()))
                }
            });
            match bytes {
                Ok(bytes) => out.write_all(&bytes)?,
                Err(e) => {
                    refused = Some(e);
                    return Err(std::io::ErrorKind::InvalidData.into());
                }
            }
        }
        Ok(())
    });
    match refused {
        Some(error) => Err(error),
        None => written,
    }
}

fn wrong_length(path: &Path, spec: &TensorSpec, got: usize) -> Error {
    let expected = format!("{} elements of {:?}", spec.elements().unwrap_or(0), spec.dtype);
    Error::format(path, expected, format!("{got} bytes")).at(format!(" tensor `{}`", spec.name))
}

/// Makes the header, padded with spaces. Its keys are sorted: the same tensors give the same
/// bytes.
fn header(
    path: &Path,
    specs: &[TensorSpec],
    metadata: &BTreeMap<String, String>,
) -> Result<Vec<u8>> {
    let bad = |expected: &str, got: String| Error::format(path, expected, got);
    let mut entries: BTreeMap<&str, Value> = BTreeMap::new();
    let mut at = 0usize;
    for spec in specs {
        let end = spec.bytes().and_then(|n| at.checked_add(n));
        let end = end.ok_or_else(|| wrong_length(path, spec, usize::MAX))?;
        let info =
            TensorInfo { dtype: spec.dtype, shape: spec.shape.clone(), data_offsets: (at, end) };
        let value = serde_json::to_value(info).map_err(|e| bad("a header", e.to_string()))?;
        if spec.name == METADATA || entries.insert(&spec.name, value).is_some() {
            return Err(bad("one tensor of each name", format!("`{}` again", spec.name)));
        }
        at = end;
    }
    entries.insert(METADATA, json!(metadata));
    let mut text = serde_json::to_vec(&entries).map_err(|e| bad("a header", e.to_string()))?;
    text.resize(text.len().next_multiple_of(ALIGNMENT), b' ');
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use safetensors::SafeTensors;

    fn spec(name: &str, dtype: Dtype, shape: &[usize]) -> TensorSpec {
        TensorSpec { name: name.to_owned(), dtype, shape: shape.to_vec() }
    }

    /// Three tensors, one of them empty, one of 3 bytes.
    fn three() -> (Vec<TensorSpec>, Vec<Vec<u8>>) {
        let specs = vec![
            spec("b", Dtype::F32, &[2, 1]),
            spec("a.x", Dtype::U8, &[3]),
            spec("c", Dtype::F16, &[0, 4]),
        ];
        (specs, vec![(0..8).collect(), vec![9, 8, 7], Vec::new()])
    }

    fn written(folder: &Path) -> PathBuf {
        let path = folder.join("t.safetensors");
        let (specs, data) = three();
        let metadata = BTreeMap::from([("k".to_owned(), "v \"q\"".to_owned())]);
        write_tensors(&path, &specs, &metadata, |i| Ok(data[i].clone())).unwrap();
        path
    }

    #[test]
    fn the_reference_implementation_reads_what_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let bytes = std::fs::read(written(folder.path())).unwrap();
        let (n, header) = SafeTensors::read_metadata(&bytes).unwrap();
        assert_eq!(n % ALIGNMENT, 0);
        assert_eq!(header.metadata().as_ref().unwrap()["k"], "v \"q\"");
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let (specs, data) = three();
        assert_eq!(file.len(), 3);
        for (spec, data) in specs.iter().zip(data) {
            let view = file.tensor(&spec.name).unwrap();
            assert_eq!((view.dtype(), view.shape()), (spec.dtype, &spec.shape[..]));
            assert_eq!(view.data(), data);
        }
    }

    #[test]
    fn tensors_come_back_one_by_one() {
        let folder = tempfile::tempdir().unwrap();
        let file = TensorFile::open(written(folder.path())).unwrap();
        let (specs, data) = three();
        assert_eq!(file.specs(), specs);
        for (spec, data) in specs.iter().zip(data) {
            assert_eq!(file.read(&spec.name).unwrap(), data);
        }
        assert_eq!((file.metadata("k"), file.metadata("x")), (Some("v \"q\""), None));
        assert!(file.read("d").unwrap_err().to_string().contains("`d`"));
    }

    #[test]
    fn damaged_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let good = std::fs::read(&path).unwrap();
        for cut in 0..good.len() {
            std::fs::write(&path, &good[..cut]).unwrap();
            let error = TensorFile::open(&path).unwrap_err().to_string();
            assert!(error.contains("safetensors"), "{cut}: {error}");
        }
        let mut longer = good.clone();
        longer.push(0);
        std::fs::write(&path, &longer).unwrap();
        assert!(TensorFile::open(&path).is_err());
        let mut huge = good;
        huge[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        std::fs::write(&path, &huge).unwrap();
        assert!(TensorFile::open(&path).is_err());
    }

    #[test]
    fn what_cannot_be_written_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("t.safetensors");
        let none = BTreeMap::new();
        let a = spec("a", Dtype::F32, &[1]);
        let refuse = |specs: &[TensorSpec], data: &dyn Fn() -> Result<Vec<u8>>| {
            write_tensors(&path, specs, &none, |_| data()).unwrap_err().to_string()
        };
        assert!(refuse(&[a.clone(), a.clone()], &|| Ok(vec![0; 4])).contains("`a` again"));
        assert!(refuse(&[spec(METADATA, Dtype::F32, &[1])], &|| Ok(vec![0; 4])).contains("again"));
        assert!(refuse(std::slice::from_ref(&a), &|| Ok(vec![0; 3])).contains("`a`"));
        let said = refuse(&[a], &|| Err(Error::format("x", "this", "that")));
        assert_eq!(said, "x: expected this, got that");
        let big = spec("big", Dtype::F32, &[usize::MAX, 2]);
        assert!(refuse(&[big], &|| Ok(Vec::new())).contains("`big`"));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
