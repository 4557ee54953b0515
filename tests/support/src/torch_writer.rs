//! Files of `torch.save`'s zip form from scratch: whole checkpoints, and such as lie.

use std::io::{Seek, SeekFrom, Write};

/// A value that a pickle of protocol 2 can hold.
#[derive(Clone)]
pub enum Py {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Str(String),
    Tuple(Vec<Py>),
    List(Vec<Py>),
    Dict(Vec<(Py, Py)>),
    /// `module name`, as `GLOBAL` has it.
    Global(&'static str),
    /// `REDUCE` of a global and its arguments.
    Call(&'static str, Vec<Py>),
    /// A persistent id.
    Persistent(Box<Py>),
    /// Instructions as they are.
    Raw(Vec<u8>),
}

pub fn text(s: &str) -> Py {
    Py::Str(s.to_owned())
}

/// A dictionary of text keys.
pub fn dict(pairs: Vec<(&str, Py)>) -> Py {
    Py::Dict(pairs.into_iter().map(|(k, v)| (text(k), v)).collect())
}

pub fn ints(values: &[i64]) -> Py {
    Py::Tuple(values.iter().map(|v| Py::Int(*v)).collect())
}

/// The storage `key` of `class` (`FloatStorage`) with `elements`.
pub fn storage(class: &'static str, key: &str, elements: i64) -> Py {
    let parts = vec![text("storage"), Py::Global(class), text(key), text("cpu"), Py::Int(elements)];
    Py::Persistent(Box::new(Py::Tuple(parts)))
}

/// `_rebuild_tensor_v2` of a storage.
pub fn tensor(storage: Py, offset: i64, shape: &[i64], strides: &[i64]) -> Py {
    let hooks = Py::Call("collections OrderedDict", Vec::new());
    let arguments =
        vec![storage, Py::Int(offset), ints(shape), ints(strides), Py::Bool(false), hooks];
    Py::Call("torch._utils _rebuild_tensor_v2", arguments)
}

impl Py {
    fn write(&self, out: &mut Vec<u8>) {
        match self {
            Py::None => out.push(b'N'),
            Py::Bool(b) => out.push(if *b { 0x88 } else { 0x89 }),
            Py::Int(i) => {
                out.extend([0x8a, 8]);
                out.extend(i.to_le_bytes());
            }
            Py::Float(f) => {
                out.push(b'G');
                out.extend(f.to_be_bytes());
            }
            Py::Str(s) => {
                out.push(b'X');
                out.extend((s.len() as u32).to_le_bytes());
                out.extend(s.bytes());
            }
            Py::Tuple(items) => {
                out.push(b'(');
                items.iter().for_each(|i| i.write(out));
                out.push(b't');
            }
            Py::List(items) => {
                out.extend(b"](");
                items.iter().for_each(|i| i.write(out));
                out.push(b'e');
            }
            Py::Dict(pairs) => {
                out.extend(b"}(");
                for (k, v) in pairs {
                    k.write(out);
                    v.write(out);
                }
                out.push(b'u');
            }
            Py::Global(name) => {
                out.push(b'c');
                out.extend(name.replace(' ', "\n").bytes());
                out.push(b'\n');
            }
            Py::Call(name, arguments) => {
                Py::Global(name).write(out);
                Py::Tuple(arguments.clone()).write(out);
                out.push(b'R');
            }
            Py::Persistent(id) => {
                id.write(out);
                out.push(b'Q');
            }
            Py::Raw(bytes) => out.extend(bytes),
        }
    }

    /// The whole pickle.
    pub fn pickle(&self) -> Vec<u8> {
        let mut out = vec![0x80, 2];
        self.write(&mut out);
        out.push(b'.');
        out
    }
}

/// Content of an entry.
#[derive(Clone)]
pub enum Data {
    Bytes(Vec<u8>),
    /// So many zeros, as a hole in the file.
    Hole(u64),
}

/// An entry, with the lies that it tells.
#[derive(Clone)]
pub struct Entry {
    pub name: String,
    pub data: Data,
    pub method: u16,
    pub flags: u16,
    pub crc: u32,
    /// Name in the local header, if another one.
    pub local_name: Option<String>,
    /// Sizes of the directory, if others.
    pub size: Option<u64>,
    /// Position of the local header in the directory, if another one.
    pub offset: Option<u64>,
}

pub fn entry(name: &str, data: &[u8]) -> Entry {
    let mut sum = flate2::Crc::new();
    sum.update(data);
    let data = Data::Bytes(data.to_vec());
    let (method, flags, crc) = (0, 0x808, sum.sum());
    let name = name.to_owned();
    Entry { name, data, method, flags, crc, local_name: None, size: None, offset: None }
}

/// Writes a zip64 archive as torch does: local headers with sizes 0 (bit 3), data on
/// multiples of 64 bytes, and a directory with zip64 fields where a number needs them.
pub fn write_zip(out: &mut (impl Write + Seek), entries: &[Entry]) -> std::io::Result<()> {
    let mut directory = Vec::new();
    let mut at = 0u64;
    for e in entries {
        let own = e.local_name.as_ref().unwrap_or(&e.name);
        let pad = (64 - (at + 30 + own.len() as u64 + 4) % 64) % 64;
        let mut head = b"PK\x03\x04\0\0".to_vec();
        head.extend(e.flags.to_le_bytes());
        head.extend(e.method.to_le_bytes());
        head.extend([0; 16]);
        head.extend((own.len() as u16).to_le_bytes());
        head.extend((pad as u16 + 4).to_le_bytes());
        head.extend(own.bytes());
        head.extend(b"FB");
        head.extend((pad as u16).to_le_bytes());
        head.resize(head.len() + pad as usize, b'Z');
        out.write_all(&head)?;
        let length = match &e.data {
            Data::Bytes(bytes) => {
                out.write_all(bytes)?;
                bytes.len() as u64
            }
            Data::Hole(bytes) => {
                out.seek(SeekFrom::Current(*bytes as i64))?;
                *bytes
            }
        };
        let (size, offset) = (e.size.unwrap_or(length), e.offset.unwrap_or(at));
        list(&mut directory, e, size, offset);
        at += head.len() as u64 + length;
    }
    let (size, count) = (directory.len() as u64, entries.len() as u64);
    let behind = at + size;
    directory.extend(b"PK\x06\x06");
    directory.extend(44u64.to_le_bytes());
    directory.extend([0x1e, 3, 0x2d, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    [count, count, size, at].iter().for_each(|n| directory.extend(n.to_le_bytes()));
    directory.extend(b"PK\x06\x07\0\0\0\0");
    directory.extend(behind.to_le_bytes());
    directory.extend(1u32.to_le_bytes());
    directory.extend(b"PK\x05\x06\0\0\0\0");
    [count, count].iter().for_each(|n| directory.extend((*n as u16).to_le_bytes()));
    let narrow = |n: u64| u32::try_from(n).unwrap_or(u32::MAX).to_le_bytes();
    directory.extend(narrow(size));
    directory.extend(narrow(at));
    directory.extend([0, 0]);
    out.write_all(&directory)
}

fn list(directory: &mut Vec<u8>, e: &Entry, size: u64, offset: u64) {
    let wide = |n: u64| n >= u64::from(u32::MAX);
    let mut extra = Vec::new();
    let mut narrow = |n: u64| {
        if wide(n) {
            extra.extend(n.to_le_bytes());
        }
        u32::try_from(n).unwrap_or(u32::MAX).to_le_bytes()
    };
    let fields = [narrow(size), narrow(size), narrow(offset)];
    directory.extend(b"PK\x01\x02\0\0\0\0");
    directory.extend(e.flags.to_le_bytes());
    directory.extend(e.method.to_le_bytes());
    directory.extend([0; 4]);
    directory.extend(e.crc.to_le_bytes());
    directory.extend(fields[0]);
    directory.extend(fields[1]);
    directory.extend((e.name.len() as u16).to_le_bytes());
    let extra_length = if extra.is_empty() { 0 } else { extra.len() as u16 + 4 };
    directory.extend(extra_length.to_le_bytes());
    directory.extend([0; 10]);
    directory.extend(fields[2]);
    directory.extend(e.name.bytes());
    if !extra.is_empty() {
        directory.extend([1, 0]);
        directory.extend((extra.len() as u16).to_le_bytes());
        directory.extend(extra);
    }
}

/// [`write_zip`] in memory.
pub fn zip(entries: &[Entry]) -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    write_zip(&mut out, entries).unwrap();
    out.into_inner()
}

/// A checkpoint in the making: storages, as tensors are added.
#[derive(Default)]
pub struct Checkpoint {
    storages: Vec<Vec<u8>>,
}

impl Checkpoint {
    /// A contiguous tensor of little-endian `bytes`.
    pub fn tensor(&mut self, class: &'static str, bytes: &[u8], shape: &[usize]) -> Py {
        let key = self.storages.len().to_string();
        let elements: usize = shape.iter().product();
        self.storages.push(bytes.to_vec());
        let mut strides = vec![1i64; shape.len()];
        for i in (1..shape.len()).rev() {
            strides[i - 1] = strides[i] * shape[i] as i64;
        }
        let shape: Vec<i64> = shape.iter().map(|s| *s as i64).collect();
        tensor(storage(class, &key, elements as i64), 0, &shape, &strides)
    }

    /// Of `f32`.
    pub fn floats(&mut self, values: &[f32], shape: &[usize]) -> Py {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensor("torch FloatStorage", &bytes, shape)
    }

    /// The archive's entries, with `root` pickled.
    pub fn entries(&self, root: &Py) -> Vec<Entry> {
        let mut entries =
            vec![entry("archive/data.pkl", &root.pickle()), entry("archive/byteorder", b"little")];
        for (i, bytes) in self.storages.iter().enumerate() {
            entries.push(entry(&format!("archive/data/{i}"), bytes));
        }
        entries.push(entry("archive/version", b"3\n"));
        entries
    }

    /// The whole file.
    pub fn file(&self, root: &Py) -> Vec<u8> {
        zip(&self.entries(root))
    }
}
