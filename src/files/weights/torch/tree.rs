//! Conversion of nodes to a tree of values: shared nodes are copied within a budget, cycles
//! are detected by depth, and every tensor is compared with its storage.

use super::pickle::{Id, Kind, MAX_VALUES, Node, Pickle, Rebuilt, Storage, StorageView};
use super::value::{StorageRef, TensorRef, Value, extent};
use super::{MAX_DEPTH, shown};
use crate::files::{Error, Result};
use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::sync::Arc;

/// Bytes of a storage in the file.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    /// Position of the first byte.
    pub(super) at: u64,
    pub(super) bytes: u64,
    /// The archive's CRC-32, where it has one.
    pub(super) crc: Option<u32>,
}

/// Builds the tree of `pickle`; `place` finds storages by key.
pub(super) struct Builder<'a> {
    pub(super) path: &'a Path,
    pub(super) pickle: &'a Pickle,
    pub(super) place: &'a dyn Fn(&str) -> Option<Place>,
    tensors: HashMap<Id, Arc<TensorRef>>,
    storages: HashMap<Arc<str>, Arc<StorageRef>>,
    budget: usize,
    /// Keys and indices from the root to the current value.
    trail: Vec<Step>,
}

enum Step {
    Key(Id),
    Index(usize),
}

impl<'a> Builder<'a> {
    pub(super) fn new(
        path: &'a Path,
        pickle: &'a Pickle,
        place: &'a dyn Fn(&str) -> Option<Place>,
    ) -> Self {
        let (tensors, storages) = (HashMap::new(), HashMap::new());
        Self { path, pickle, place, tensors, storages, budget: MAX_VALUES, trail: Vec::new() }
    }

    /// Converts the whole tree.
    pub(super) fn root(mut self) -> Result<Value> {
        self.value(self.pickle.root)
    }

    fn node(&self, id: Id) -> &'a Node {
        self.pickle.nodes.get(id as usize).unwrap_or(&Node::None)
    }

    /// Formats the keys and indices from the root, such as `state_dict.encoder.weight`.
    fn place_in_file(&self) -> String {
        let steps = self.trail.iter().map(|step| match step {
            Step::Index(i) => format!("[{i}]"),
            Step::Key(id) => match self.node(*id) {
                Node::Str(key) => shown(key),
                Node::Int(i) => i.to_string(),
                _ => "?".to_owned(),
            },
        });
        let all = steps.collect::<Vec<_>>().join(".");
        // The name is cut where it is longer than any weight's.
        if all.is_empty() { " at the root".to_owned() } else { format!(" at `{}`", shown(&all)) }
    }

    fn bad(&self, expected: impl Into<String>, got: impl Into<String>) -> Error {
        Error::format(self.path, expected, got).at(self.place_in_file())
    }

    fn value(&mut self, id: Id) -> Result<Value> {
        if self.trail.len() > MAX_DEPTH {
            let expected = format!("values nested at most {MAX_DEPTH} deep");
            let got = "deeper ones, or a value that contains itself";
            return Err(Error::format(self.path, expected, got));
        }
        let Some(left) = self.budget.checked_sub(1) else {
            let expected = format!("at most {MAX_VALUES} values, with shared ones written out");
            return Err(Error::format(self.path, expected, "more"));
        };
        self.budget = left;
        Ok(match self.node(id) {
            Node::None => Value::None,
            Node::Bool(b) => Value::Bool(*b),
            Node::Int(i) => Value::Int(*i),
            Node::Big(b) => Value::BigInt(b.clone()),
            Node::Float(f) => Value::Float(*f),
            Node::Str(s) => Value::Str(s.clone()),
            Node::Bytes(b) => Value::Bytes(b.clone()),
            Node::List(items) => Value::List(self.values(items)?),
            Node::Tuple(items) => Value::Tuple(self.values(items)?),
            Node::Set(items) => Value::Set(self.values(items)?),
            Node::Dict(pairs) => Value::Dict(self.dictionary(pairs)?),
            Node::Global(name) | Node::Opaque(name) => Value::Opaque(name.clone()),
            Node::Storage(_) => Value::Opaque("torch.storage".into()),
            Node::Tensor(tensor) => Value::Tensor(self.tensor(id, tensor)?),
        })
    }

    fn values(&mut self, items: &[Id]) -> Result<Vec<Value>> {
        let mut values = Vec::new();
        for (i, item) in items.iter().enumerate() {
            self.trail.push(Step::Index(i));
            values.push(self.value(*item)?);
            self.trail.pop();
        }
        Ok(values)
    }

    fn dictionary(&mut self, pairs: &'a [(Id, Id)]) -> Result<Vec<(Value, Value)>> {
        let mut values = Vec::new();
        let (mut texts, mut numbers) = (HashSet::new(), HashSet::new());
        for (key, value) in pairs {
            self.trail.push(Step::Key(*key));
            // Other readers disagree about the value of a repeated key.
            let fresh = match self.node(*key) {
                Node::Str(text) => texts.insert(&**text),
                Node::Int(number) => numbers.insert(*number),
                _ => true,
            };
            if !fresh {
                return Err(self.bad("a key once in its dictionary", "it twice"));
            }
            values.push((self.value(*key)?, self.value(*value)?));
            self.trail.pop();
        }
        Ok(values)
    }

    fn tensor(&mut self, id: Id, rebuilt: &Rebuilt) -> Result<Arc<TensorRef>> {
        if let Some(tensor) = self.tensors.get(&id) {
            return Ok(tensor.clone());
        }
        let storage = self.storage(&rebuilt.storage)?;
        let Rebuilt { dtype, offset, requires_grad, .. } = *rebuilt;
        let (shape, strides) = (&rebuilt.shape, &rebuilt.strides);
        let inside = match extent(dtype, shape, strides, offset) {
            Some(end) => end <= storage.bytes || shape.contains(&0),
            None => false,
        };
        if !inside {
            let expected = format!("a tensor inside its storage of {} bytes", storage.bytes);
            let (shape, strides) = (list(shape), list(strides));
            let got = format!(
                "shape {shape}, strides {strides}, offset {offset} of {}, past its end",
                dtype.name()
            );
            return Err(self.bad(expected, got));
        }
        let (shape, strides) = (shape.clone(), strides.clone());
        let tensor = Arc::new(TensorRef { dtype, shape, strides, offset, storage, requires_grad });
        self.tensors.insert(id, tensor.clone());
        Ok(tensor)
    }

    /// Finds a storage, which must have the size that the pickle declares.
    fn storage(&mut self, storage: &Storage) -> Result<Arc<StorageRef>> {
        if let Some(known) = self.storages.get(&storage.key)
            && storage.view.is_none()
        {
            return Ok(known.clone());
        }
        let key = shown(&storage.key);
        let Some(Place { at, bytes: stored, crc }) = (self.place)(&storage.key) else {
            return Err(self.bad(format!("storage `{key}` in the file"), "none"));
        };
        let size = storage.kind.size() as u64;
        let bytes = storage.elements.checked_mul(size);
        // A storage of bytes that was converted to floats may end in part of a float.
        let Some(bytes) = bytes.filter(|b| *b <= stored && stored - b < size.max(2)) else {
            let expected =
                format!("{} elements of {size} bytes in storage `{key}`", storage.elements);
            return Err(self.bad(expected, format!("{stored} bytes")));
        };
        if let Some(StorageView { first, elements }) = storage.view {
            let range = first.checked_mul(size).zip(elements.checked_mul(size));
            let inside = range.filter(|(f, n)| f.checked_add(*n).is_some_and(|end| end <= bytes));
            let Some((first, bytes)) = inside else {
                let expected = format!("a view inside storage `{key}` of {bytes} bytes");
                let got = format!("{elements} elements from {first}");
                return Err(self.bad(expected, got));
            };
            let key = storage.key.clone();
            let (at, stored) = (at + first, bytes);
            return Ok(Arc::new(StorageRef { key, at, bytes, stored, crc: None }));
        }
        let key = storage.key.clone();
        let found = Arc::new(StorageRef { key: key.clone(), at, bytes, stored, crc });
        self.storages.insert(key, found.clone());
        Ok(found)
    }
}

/// Formats a shape, cut after eight sizes.
fn list(sizes: &[usize]) -> String {
    let head: Vec<String> = sizes.iter().take(8).map(usize::to_string).collect();
    let more = if sizes.len() > 8 { ", …" } else { "" };
    format!("[{}{more}]", head.join(", "))
}

/// Returns the bytes of a legacy storage's elements, for [`super::legacy`].
pub(super) fn bytes_of(kind: &Kind, elements: u64) -> Option<u64> {
    elements.checked_mul(kind.size() as u64)
}
