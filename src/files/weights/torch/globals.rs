//! The classes and functions that a pickle may name: parts of tensors and plain containers.
//! Any other name becomes [`Node::Opaque`], and its arguments are dropped.

use super::pickle::{Id, Kind, Machine, Node, Rebuilt, Storage, StorageView};
use super::shown;
use super::value::TorchDtype;
use crate::files::Result;
use std::sync::Arc;

/// Largest number of dimensions of a PyTorch tensor.
const MAX_DIMENSIONS: usize = 64;

/// Names that are interpreted, besides storages and element types.
const UNDERSTOOD: &[&str] = &[
    "collections.OrderedDict",
    "collections.defaultdict",
    "collections.Counter",
    "collections.deque",
    "_codecs.encode",
    "torch.Size",
    "torch.device",
    "torch.Tensor",
    "torch._C.TensorBase",
    "torch.nn.parameter.Parameter",
    "torch.nn.parameter.Buffer",
    "torch.serialization._get_layout",
    "torch._utils._rebuild_tensor",
    "torch._utils._rebuild_tensor_v2",
    "torch._utils._rebuild_tensor_v3",
    "torch._utils._rebuild_parameter",
    "torch._utils._rebuild_parameter_with_state",
    "torch._tensor._rebuild_from_type_v2",
];

/// Types of Python's `builtins` (`__builtin__` in protocol 2).
const BUILTINS: &[&str] = &[
    "set",
    "frozenset",
    "list",
    "dict",
    "tuple",
    "bytearray",
    "bytes",
    "int",
    "long",
    "float",
    "bool",
    "str",
    "object",
];

fn builtin(name: &str) -> Option<&str> {
    let bare = name.strip_prefix("builtins.").or_else(|| name.strip_prefix("__builtin__."))?;
    BUILTINS.contains(&bare).then_some(bare)
}

/// Reports whether a name belongs to tensors or plain containers.
pub(super) fn understood(name: &str) -> bool {
    UNDERSTOOD.contains(&name)
        || builtin(name).is_some()
        || dtype(name).is_some()
        || matches!(kind(name), Some(Kind::Known(_) | Kind::Untyped))
}

/// Parses an element type such as `torch.float32`.
fn dtype(name: &str) -> Option<TorchDtype> {
    TorchDtype::from_name(name.strip_prefix("torch.")?)
}

/// Parses a storage class: `torch.FloatStorage`, `torch.cuda.FloatStorage`,
/// `torch.storage.UntypedStorage`, ….
fn kind(name: &str) -> Option<Kind> {
    let bare = ["torch.cuda.", "torch.storage.", "torch."]
        .iter()
        .find_map(|module| name.strip_prefix(module))?;
    Some(Kind::Known(match bare.strip_suffix("Storage")? {
        "Double" => TorchDtype::F64,
        "Float" => TorchDtype::F32,
        "Half" => TorchDtype::F16,
        "BFloat16" => TorchDtype::BF16,
        "Long" => TorchDtype::I64,
        "Int" => TorchDtype::I32,
        "Short" => TorchDtype::I16,
        "Char" => TorchDtype::I8,
        "Byte" => TorchDtype::U8,
        "Bool" => TorchDtype::Bool,
        "Untyped" | "_Untyped" => return Some(Kind::Untyped),
        "ComplexDouble" => return Some(Kind::Other(name.into(), 16)),
        "ComplexFloat" => return Some(Kind::Other(name.into(), 8)),
        "QInt32" => return Some(Kind::Other(name.into(), 4)),
        "QInt8" | "QUInt8" | "QUInt4x2" | "QUInt2x4" => {
            return Some(Kind::Other(name.into(), 1));
        }
        _ => return None,
    }))
}

/// Parses a storage's persistent id, `("storage", type, key, location, elements)`, with a
/// view in legacy files: `None` or `(key, first element, elements)`. The location (`cpu`,
/// `cuda:0`) is not used.
pub(super) fn storage(machine: &Machine, id: Id) -> Result<Storage> {
    let wrong = || {
        let expected = "a storage as persistent id (\"storage\", type, key, location, size)";
        machine.bad(expected, machine.kind(id))
    };
    let Node::Tuple(parts) = machine.node(id) else { return Err(wrong()) };
    let [tag, class, key, _location, elements, view @ ..] = parts.as_slice() else {
        return Err(wrong());
    };
    let (Node::Str(tag), Node::Global(class), Node::Str(key), Node::Int(elements)) =
        (machine.node(*tag), machine.node(*class), machine.node(*key), machine.node(*elements))
    else {
        return Err(wrong());
    };
    let elements = u64::try_from(*elements).map_err(|_| wrong())?;
    if &**tag != "storage" || key.len() > 64 {
        return Err(wrong());
    }
    let Some(kind) = kind(class) else {
        return Err(machine.bad("a type of storage", shown(class)));
    };
    let view = match view {
        [] => None,
        [view] => match machine.node(*view) {
            Node::None => None,
            Node::Tuple(v) if v.len() == 3 => {
                let part = |i: usize| match v.get(i).map(|id| machine.node(*id)) {
                    Some(Node::Int(n)) => u64::try_from(*n).map_err(|_| wrong()),
                    _ => Err(wrong()),
                };
                Some(StorageView { first: part(1)?, elements: part(2)? })
            }
            _ => return Err(wrong()),
        },
        _ => return Err(wrong()),
    };
    Ok(Storage { key: key.clone(), kind, elements, view })
}

/// Returns the class of a persistent id `("module", class, file, source)`. Legacy files
/// store the source text of a model's classes in it.
pub(super) fn module(machine: &Machine, id: Id) -> Option<Id> {
    let Node::Tuple(parts) = machine.node(id) else { return None };
    let [tag, class, ..] = parts.as_slice() else { return None };
    match (machine.node(*tag), machine.node(*class)) {
        (Node::Str(tag), Node::Global(_)) if &**tag == "module" => Some(*class),
        _ => None,
    }
}

/// Makes the value of `callee(*arguments)`: data, or [`Node::Opaque`].
pub(super) fn call(machine: &mut Machine, callee: Id, arguments: Id) -> Result<Id> {
    let name = match machine.node(callee) {
        Node::Global(name) | Node::Opaque(name) => name.clone(),
        _ => return Err(machine.bad("the name of a class or function", machine.kind(callee))),
    };
    let arguments = match machine.node(arguments) {
        Node::Tuple(arguments) if understood(&name) => {
            let arguments = arguments.clone();
            machine.charge(arguments.len())?;
            arguments
        }
        Node::Tuple(arguments) => {
            // A function of `copyreg` makes an object of the class in its arguments.
            let class = arguments.first().map(|class| machine.node(*class));
            let name = match class {
                Some(Node::Global(class)) if name.starts_with("copy") => class.clone(),
                _ => name,
            };
            return machine.make(Node::Opaque(name));
        }
        _ => return Err(machine.bad("a tuple of arguments", machine.kind(arguments))),
    };
    match &*name {
        "torch._utils._rebuild_tensor"
        | "torch._utils._rebuild_tensor_v2"
        | "torch._utils._rebuild_tensor_v3" => tensor(machine, &name, &arguments),
        "torch._utils._rebuild_parameter" | "torch._utils._rebuild_parameter_with_state" => {
            parameter(machine, &name, &arguments)
        }
        "torch._tensor._rebuild_from_type_v2" => from_type(machine, &name, &arguments),
        "collections.defaultdict" => match arguments.as_slice() {
            [_factory, rest @ ..] => dictionary(machine, &name, rest),
            [] => dictionary(machine, &name, &[]),
        },
        "collections.OrderedDict" | "collections.Counter" => dictionary(machine, &name, &arguments),
        "torch.Size" => match (arguments.first(), arguments.first().map(|a| machine.node(*a))) {
            (Some(sizes), Some(Node::Tuple(_))) => Ok(*sizes),
            _ => container(machine, "tuple", &name, &arguments),
        },
        "collections.deque" => container(machine, "list", &name, &arguments),
        "_codecs.encode" => encoded(machine, &name, &arguments),
        _ => match builtin(&name) {
            Some("dict") => dictionary(machine, &name, &arguments),
            Some(bare @ ("list" | "set" | "frozenset" | "tuple")) => {
                container(machine, bare, &name, &arguments)
            }
            Some("bytes" | "bytearray") => encoded(machine, &name, &arguments),
            _ => machine.make(Node::Opaque(name.clone())),
        },
    }
}

/// Makes `OrderedDict()`, `OrderedDict([[k, v], …])`, `Counter({…})`.
fn dictionary(machine: &mut Machine, name: &Arc<str>, arguments: &[Id]) -> Result<Id> {
    let pair = |id: &Id| match machine.node(*id) {
        Node::List(p) | Node::Tuple(p) => {
            p.as_slice().try_into().ok().map(|[k, v]: [Id; 2]| (k, v))
        }
        _ => None,
    };
    let pairs = match arguments.first().map(|a| machine.node(*a)) {
        None => Some(Vec::new()),
        Some(Node::Dict(pairs)) => Some(pairs.clone()),
        Some(Node::List(items) | Node::Tuple(items)) => items.iter().map(pair).collect(),
        _ => None,
    };
    match pairs {
        Some(pairs) => {
            machine.charge(pairs.len())?;
            machine.make(Node::Dict(pairs))
        }
        None => machine.make(Node::Opaque(name.clone())),
    }
}

/// Makes `list(x)`, `set(x)`, `tuple(x)`, `deque(x, maximum)`.
fn container(machine: &mut Machine, bare: &str, name: &Arc<str>, arguments: &[Id]) -> Result<Id> {
    let items = match arguments.first().map(|a| machine.node(*a)) {
        None => Vec::new(),
        Some(Node::List(items) | Node::Tuple(items) | Node::Set(items)) => items.clone(),
        _ => return machine.make(Node::Opaque(name.clone())),
    };
    machine.charge(items.len())?;
    machine.make(match bare {
        "list" => Node::List(items),
        "tuple" => Node::Tuple(items),
        _ => Node::Set(items),
    })
}

/// Makes `bytes` and `bytearray`, in protocol 2 from `encode(text, "latin1")`.
fn encoded(machine: &mut Machine, name: &Arc<str>, arguments: &[Id]) -> Result<Id> {
    let Some(first) = arguments.first() else {
        return machine.make(Node::Bytes(Arc::from([])));
    };
    let latin = match arguments.get(1).map(|e| machine.node(*e)) {
        Some(Node::Str(encoding)) => encoding.starts_with("latin"),
        _ => false,
    };
    let bytes = match machine.node(*first) {
        Node::Bytes(bytes) => Some(bytes.clone()),
        Node::Str(text) if latin => {
            // Each call makes a copy: one node of the budget for 32 bytes.
            let text = text.clone();
            machine.charge(text.len() / 32)?;
            let bytes: Option<Vec<u8>> = text.chars().map(|c| u8::try_from(c).ok()).collect();
            bytes.map(Arc::from)
        }
        _ => None,
    };
    match bytes {
        Some(bytes) => machine.make(Node::Bytes(bytes)),
        None => machine.make(Node::Opaque(name.clone())),
    }
}

/// Makes a tensor of `_rebuild_tensor(storage, offset, shape, strides)`. v2 adds
/// `requires_grad`, hooks and metadata; v3 adds the element type before the metadata.
fn tensor(machine: &mut Machine, name: &Arc<str>, arguments: &[Id]) -> Result<Id> {
    let [storage, offset, shape, strides, rest @ ..] = arguments else {
        let got = format!("{} of them", arguments.len());
        return Err(machine.bad("a tensor's storage, offset, shape and strides", got));
    };
    let storage = match machine.node(*storage) {
        Node::Storage(storage) => storage.clone(),
        _ => return Err(machine.bad("a tensor's storage", machine.kind(*storage))),
    };
    let (own_type, metadata) = match &**name {
        "torch._utils._rebuild_tensor_v3" => (rest.get(2), rest.get(3)),
        _ => (None, rest.get(2)),
    };
    // The metadata hold pending negation or conjugation.
    match metadata.map(|m| machine.node(*m)) {
        None | Some(Node::None) => {}
        Some(Node::Dict(pairs)) if pairs.is_empty() => {}
        Some(_) => return machine.make(Node::Opaque(format!("{name} with metadata").into())),
    }
    let dtype = match (own_type.map(|t| machine.node(*t)), &storage.kind) {
        (Some(Node::Global(name)), _) => match dtype(name) {
            Some(dtype) => dtype,
            None => return machine.make(Node::Opaque(name.clone())),
        },
        (_, Kind::Known(dtype)) => *dtype,
        (_, Kind::Untyped) => TorchDtype::U8,
        (_, Kind::Other(name, _)) => {
            let name = name.clone();
            return machine.make(Node::Opaque(name));
        }
    };
    let shape = sizes(machine, *shape, "a tensor's shape")?;
    let strides = sizes(machine, *strides, "a tensor's strides")?;
    if shape.len() != strides.len() {
        let got = format!("{} for {}", strides.len(), shape.len());
        return Err(machine.bad("a stride for each of a tensor's dimensions", got));
    }
    let offset = size(machine, *offset, "a tensor's offset")?;
    let requires_grad = matches!(rest.first().map(|g| machine.node(*g)), Some(Node::Bool(true)));
    machine.charge(shape.len())?;
    let rebuilt = Rebuilt { storage, dtype, offset, shape, strides, requires_grad };
    machine.make(Node::Tensor(Arc::new(rebuilt)))
}

fn size(machine: &Machine, id: Id, what: &str) -> Result<usize> {
    match machine.node(id) {
        Node::Int(n) if *n >= 0 => Ok(*n as usize),
        _ => Err(machine.bad(format!("{what} of integers from 0"), machine.kind(id))),
    }
}

fn sizes(machine: &Machine, id: Id, what: &str) -> Result<Vec<usize>> {
    match machine.node(id) {
        Node::Tuple(items) | Node::List(items) if items.len() <= MAX_DIMENSIONS => {
            items.iter().map(|i| size(machine, *i, what)).collect()
        }
        _ => {
            let expected = format!("{what}, a tuple of at most {MAX_DIMENSIONS}");
            Err(machine.bad(expected, machine.kind(id)))
        }
    }
}

/// Makes a parameter of `_rebuild_parameter(tensor, requires_grad, hooks[, state])`.
fn parameter(machine: &mut Machine, name: &Arc<str>, arguments: &[Id]) -> Result<Id> {
    let Some(first) = arguments.first().copied() else {
        return machine.make(Node::Opaque(name.clone()));
    };
    let Node::Tensor(data) = machine.node(first) else {
        // An opaque tensor keeps its name.
        let known = matches!(machine.node(first), Node::Opaque(_));
        return if known { Ok(first) } else { machine.make(Node::Opaque(name.clone())) };
    };
    let requires_grad =
        matches!(arguments.get(1).map(|g| machine.node(*g)), Some(Node::Bool(true)));
    let parameter = Rebuilt { requires_grad, ..(**data).clone() };
    machine.charge(parameter.shape.len())?;
    machine.make(Node::Tensor(Arc::new(parameter)))
}

/// Makes a tensor with attributes of `_rebuild_from_type_v2(function, class, arguments,
/// state)`. A tensor of a subclass is opaque.
fn from_type(machine: &mut Machine, name: &Arc<str>, arguments: &[Id]) -> Result<Id> {
    let [function, class, inner, ..] = arguments else {
        return machine.make(Node::Opaque(name.clone()));
    };
    match (machine.node(*function), machine.node(*class)) {
        (Node::Global(function), Node::Global(class))
            if function.starts_with("torch._utils._rebuild_")
                && matches!(
                    &**class,
                    "torch.Tensor"
                        | "torch._C.TensorBase"
                        | "torch.nn.parameter.Parameter"
                        | "torch.nn.parameter.Buffer"
                ) =>
        {
            let function = function.clone();
            let id = machine.make(Node::Global(function))?;
            call(machine, id, *inner)
        }
        (_, Node::Global(class)) => {
            let class = class.clone();
            machine.make(Node::Opaque(class))
        }
        _ => machine.make(Node::Opaque(name.clone())),
    }
}
