//! The content of a pickle as plain data.

use std::sync::Arc;

/// Element type of a tensor's storage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum TorchDtype {
    /// `torch.float64`.
    F64,
    /// `torch.float32`.
    F32,
    /// `torch.float16`.
    F16,
    /// `torch.bfloat16`.
    BF16,
    /// `torch.int64`.
    I64,
    /// `torch.int32`.
    I32,
    /// `torch.int16`.
    I16,
    /// `torch.int8`.
    I8,
    /// `torch.uint8`.
    U8,
    /// `torch.bool`, one byte each.
    Bool,
}

impl TorchDtype {
    /// Returns the bytes of one element.
    pub fn size(self) -> usize {
        match self {
            Self::F64 | Self::I64 => 8,
            Self::F32 | Self::I32 => 4,
            Self::F16 | Self::BF16 | Self::I16 => 2,
            Self::I8 | Self::U8 | Self::Bool => 1,
        }
    }

    /// Returns PyTorch's name without `torch.`.
    pub fn name(self) -> &'static str {
        match self {
            Self::F64 => "float64",
            Self::F32 => "float32",
            Self::F16 => "float16",
            Self::BF16 => "bfloat16",
            Self::I64 => "int64",
            Self::I32 => "int32",
            Self::I16 => "int16",
            Self::I8 => "int8",
            Self::U8 => "uint8",
            Self::Bool => "bool",
        }
    }

    /// Parses PyTorch's name without `torch.`, or an alias (`half`, `long`, …).
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "float64" | "double" => Self::F64,
            "float32" | "float" => Self::F32,
            "float16" | "half" => Self::F16,
            "bfloat16" => Self::BF16,
            "int64" | "long" => Self::I64,
            "int32" | "int" => Self::I32,
            "int16" | "short" => Self::I16,
            "int8" => Self::I8,
            "uint8" => Self::U8,
            "bool" => Self::Bool,
            _ => return None,
        })
    }
}

/// A storage of the file. Tensors that share a storage have equal ones.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct StorageRef {
    /// Key in the file: `0`, `1`, … in zip files, a number in legacy ones.
    pub key: Arc<str>,
    /// Position of the first byte in the file.
    pub(super) at: u64,
    /// Length of the elements in bytes.
    pub(super) bytes: u64,
    /// Length in the archive, which may end in part of an element.
    pub(super) stored: u64,
    /// The archive's CRC-32 of the `stored` bytes, where it has one.
    pub(super) crc: Option<u32>,
}

impl StorageRef {
    /// Returns the length in bytes; the file holds them.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }
}

/// A tensor of the file: a view that lies inside a storage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TensorRef {
    /// Element type.
    pub dtype: TorchDtype,
    /// Sizes, outermost first; empty for a scalar. The product of the sizes above zero fits
    /// `usize`.
    pub shape: Vec<usize>,
    /// Elements from one index to the next, for each dimension; 0 where expanded.
    pub strides: Vec<usize>,
    /// Elements from the storage's start to the first one.
    pub offset: usize,
    /// Storage of the elements.
    pub storage: Arc<StorageRef>,
    /// `requires_grad` of the tensor or parameter.
    pub requires_grad: bool,
}

impl TensorRef {
    /// Returns the number of elements.
    pub fn elements(&self) -> usize {
        self.shape.iter().product()
    }
}

/// Returns the bytes from a storage's start to the end of a view's last element, or to the
/// offset for an empty view. `None` above 63 bits, or where shape and strides differ in
/// length.
pub(super) fn extent(
    dtype: TorchDtype,
    shape: &[usize],
    strides: &[usize],
    offset: usize,
) -> Option<u64> {
    let size = dtype.size();
    let whole = shape.iter().try_fold(size, |n, s| n.checked_mul((*s).max(1)))?;
    isize::try_from(whole).ok().filter(|_| shape.len() == strides.len())?;
    let last = shape.iter().zip(strides).try_fold(offset, |at, (s, stride)| {
        at.checked_add(s.saturating_sub(1).checked_mul(*stride)?)
    })?;
    let end = last.checked_add(usize::from(!shape.contains(&0)))?.checked_mul(size)?;
    isize::try_from(end).ok().map(|end| end as u64)
}

/// A value of the pickle. The tree is at most [`super::MAX_DEPTH`] deep.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// `None`.
    None,
    /// `True`, `False`.
    Bool(bool),
    /// An integer of at most 64 bits.
    Int(i64),
    /// A longer integer: two's complement, little-endian.
    BigInt(Arc<[u8]>),
    /// A float.
    Float(f64),
    /// A text.
    Str(Arc<str>),
    /// `bytes`, `bytearray`.
    Bytes(Arc<[u8]>),
    /// `list`, `deque`.
    List(Vec<Value>),
    /// `tuple`, `torch.Size`.
    Tuple(Vec<Value>),
    /// `set`, `frozenset`, in the file's order.
    Set(Vec<Value>),
    /// `dict`, `OrderedDict`, `defaultdict`, `Counter`, in the file's order; texts and
    /// integers among the keys are unique.
    Dict(Vec<(Value, Value)>),
    /// A tensor or parameter.
    Tensor(Arc<TensorRef>),
    /// Any other object: `module.name` of the class or function that would construct it.
    /// Nothing is called, and the arguments are dropped.
    Opaque(Arc<str>),
}

impl Value {
    /// Returns the value at a text key of a dictionary.
    pub fn get(&self, key: &str) -> Option<&Value> {
        self.entries().find(|(k, _)| k.as_str() == Some(key)).map(|(_, v)| v)
    }

    /// Iterates over the entries of a dictionary in the file's order; empty for other values.
    pub fn entries(&self) -> impl Iterator<Item = (&Value, &Value)> {
        let pairs: &[(Value, Value)] = if let Self::Dict(pairs) = self { pairs } else { &[] };
        pairs.iter().map(|(k, v)| (k, v))
    }

    /// Returns the items of a list, tuple or set.
    pub fn items(&self) -> Option<&[Value]> {
        match self {
            Self::List(items) | Self::Tuple(items) | Self::Set(items) => Some(items),
            _ => None,
        }
    }

    /// Returns a text.
    pub fn as_str(&self) -> Option<&str> {
        if let Self::Str(s) = self { Some(s) } else { None }
    }

    /// Returns an integer of at most 64 bits (not a bool).
    pub fn as_int(&self) -> Option<i64> {
        if let Self::Int(i) = self { Some(*i) } else { None }
    }

    /// Returns a float, or an integer as a float.
    pub fn as_float(&self) -> Option<f64> {
        match self {
            Self::Float(f) => Some(*f),
            Self::Int(i) => Some(*i as f64),
            _ => None,
        }
    }

    /// Returns a bool.
    pub fn as_bool(&self) -> Option<bool> {
        if let Self::Bool(b) = self { Some(*b) } else { None }
    }

    /// Returns a tensor or parameter.
    pub fn as_tensor(&self) -> Option<&TensorRef> {
        if let Self::Tensor(t) = self { Some(t) } else { None }
    }

    /// Describes the value for messages: `a list of 3`, `an object of os.system`.
    pub fn kind(&self) -> String {
        match self {
            Self::None => "None".to_owned(),
            Self::Bool(_) => "a bool".to_owned(),
            Self::Int(_) | Self::BigInt(_) => "an integer".to_owned(),
            Self::Float(_) => "a float".to_owned(),
            Self::Str(_) => "a text".to_owned(),
            Self::Bytes(b) => format!("{} bytes", b.len()),
            Self::List(v) => format!("a list of {}", v.len()),
            Self::Tuple(v) => format!("a tuple of {}", v.len()),
            Self::Set(v) => format!("a set of {}", v.len()),
            Self::Dict(v) => format!("a dictionary of {}", v.len()),
            Self::Tensor(t) => format!("a {} tensor of shape {:?}", t.dtype.name(), t.shape),
            Self::Opaque(name) => format!("an object of {name}"),
        }
    }
}
