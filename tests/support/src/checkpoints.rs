//! State dicts, and what checkpoints keep around them, as files of `torch.save`. For
//! tests that need ones larger than what should be committed. (A test that uses this
//! names `torch_writer` as well.)

use crate::torch_writer::{Checkpoint, Py, dict, text};

/// A value in a checkpoint.
pub enum Item {
    None,
    Int(i64),
    Float(f64),
    Text(String),
    List(Vec<Item>),
    Dict(Vec<(String, Item)>),
    /// `OrderedDict` with the attribute `_metadata` that `Module.state_dict` gives it.
    StateDict(Vec<(String, Item)>),
    /// Storage class (`torch FloatStorage`), shape, little-endian elements.
    Tensor(&'static str, Vec<usize>, Vec<u8>),
    /// An object of a class (`module name`).
    Object(&'static str),
}

/// An f32 tensor.
pub fn floats(shape: &[usize], values: &[f32]) -> Item {
    assert_eq!(shape.iter().product::<usize>(), values.len());
    let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    Item::Tensor("torch FloatStorage", shape.to_vec(), bytes)
}

/// The bytes of the file.
pub fn saved(root: &Item) -> Vec<u8> {
    let mut file = Checkpoint::default();
    let root = pickled(root, &mut file);
    file.file(&root)
}

fn pickled(item: &Item, file: &mut Checkpoint) -> Py {
    let mut entries = |entries: &[(String, Item)]| {
        Py::Dict(entries.iter().map(|(k, v)| (text(k), pickled(v, file))).collect())
    };
    match item {
        Item::None => Py::None,
        Item::Int(i) => Py::Int(*i),
        Item::Float(f) => Py::Float(*f),
        Item::Text(s) => text(s),
        Item::Dict(pairs) => entries(pairs),
        Item::StateDict(pairs) => state_dict(&entries(pairs)),
        Item::List(items) => Py::List(items.iter().map(|i| pickled(i, file)).collect()),
        Item::Tensor(class, shape, bytes) => file.tensor(class, bytes, shape),
        Item::Object(class) => Py::Call(class, Vec::new()),
    }
}

fn state_dict(pairs: &Py) -> Py {
    let empty = || Py::Call("collections OrderedDict", Vec::new());
    let mut code = body(&empty());
    // The same items, put into the ordered dictionary instead of a new plain one.
    code.extend(&body(pairs)[1..]);
    code.extend(body(&dict(vec![("_metadata", empty())])));
    code.push(b'b');
    Py::Raw(code)
}

/// The pickle's instructions without protocol and end.
fn body(py: &Py) -> Vec<u8> {
    let pickle = py.pickle();
    pickle[2..pickle.len() - 1].to_vec()
}
