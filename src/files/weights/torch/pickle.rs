//! Interpreter of pickles, protocols 2 to 5, into nodes of plain data.
//!
//! The machine has a stack and a memo of node indices; shared nodes and cycles are stored
//! once. It cannot call functions: `REDUCE` and similar instructions pass a name and
//! arguments to [`super::globals`], which makes a node for tensors and plain containers.

use super::globals;
use super::shown;
use super::source::Stream;
use super::value::TorchDtype;
use crate::files::{Error, Result};
use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

/// Largest pickle, bytes. The pickle of a large checkpoint has a few hundred kilobytes, that
/// of a data set's chunk a few megabytes.
pub(super) const MAX_PICKLE: u64 = 64 << 20;

/// Largest number of nodes of a pickle, of values after shared nodes are copied, and of
/// entries of the memo and the stack.
pub(super) const MAX_VALUES: usize = 1 << 21;

/// Largest number of open containers; Python's pickler stops near 500.
const MAX_MARKS: usize = 10_000;

/// Largest number of instructions of a pickle.
const MAX_STEPS: usize = 1 << 25;

/// Longest name of a module or class, bytes.
const MAX_NAME: usize = 256;

/// Largest number of distinct names of classes and functions.
const MAX_NAMES: usize = 10_000;

/// Index of a node.
pub(super) type Id = u32;

/// Element type of a storage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// A type that is read.
    Known(TorchDtype),
    /// Untyped bytes; the tensor has the element type.
    Untyped,
    /// `torch.ComplexFloatStorage` and others, with the bytes of an element.
    Other(Arc<str>, usize),
}

impl Kind {
    /// Returns the bytes of one element.
    pub(super) fn size(&self) -> usize {
        match self {
            Self::Known(dtype) => dtype.size(),
            Self::Untyped => 1,
            Self::Other(_, size) => *size,
        }
    }
}

/// A part of a storage in a legacy file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct StorageView {
    /// First element.
    pub(super) first: u64,
    pub(super) elements: u64,
}

/// A storage as the pickle names it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Storage {
    pub(super) key: Arc<str>,
    pub(super) kind: Kind,
    /// Elements of the whole storage.
    pub(super) elements: u64,
    /// The part that the id refers to, in legacy files.
    pub(super) view: Option<StorageView>,
}

/// A tensor as the pickle describes it, before its comparison with the storage.
#[derive(Clone, Debug)]
pub(super) struct Rebuilt {
    pub(super) storage: Arc<Storage>,
    pub(super) dtype: TorchDtype,
    pub(super) offset: usize,
    pub(super) shape: Vec<usize>,
    pub(super) strides: Vec<usize>,
    pub(super) requires_grad: bool,
}

/// A value whose parts are indices of nodes.
#[derive(Clone, Debug)]
pub(super) enum Node {
    None,
    Bool(bool),
    Int(i64),
    Big(Arc<[u8]>),
    Float(f64),
    Str(Arc<str>),
    Bytes(Arc<[u8]>),
    List(Vec<Id>),
    Tuple(Vec<Id>),
    Set(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    /// A class, a function or another named object.
    Global(Arc<str>),
    Storage(Arc<Storage>),
    Tensor(Arc<Rebuilt>),
    Opaque(Arc<str>),
}

/// The result of a pickle.
#[derive(Debug)]
pub(super) struct Pickle {
    pub(super) nodes: Vec<Node>,
    pub(super) root: Id,
    /// Names that [`globals`] does not interpret.
    pub(super) opaque: BTreeSet<String>,
    /// Every named storage by key.
    pub(super) storages: HashMap<Arc<str>, Arc<Storage>>,
}

/// The interpreter's state.
pub(super) struct Machine<'s, 'f> {
    stream: &'s mut Stream<'f>,
    nodes: Vec<Node>,
    stack: Vec<Id>,
    marks: Vec<usize>,
    memo: HashMap<u32, Id>,
    opaque: BTreeSet<String>,
    storages: HashMap<Arc<str>, Arc<Storage>>,
    /// Number of nodes that may still be made.
    budget: usize,
    /// Position in the file of the current instruction.
    at: u64,
}

/// Runs one pickle of the stream, up to its `STOP`.
pub(super) fn run(stream: &mut Stream) -> Result<Pickle> {
    let mut machine = Machine {
        stream,
        nodes: Vec::new(),
        stack: Vec::new(),
        marks: Vec::new(),
        memo: HashMap::new(),
        opaque: BTreeSet::new(),
        storages: HashMap::new(),
        budget: MAX_VALUES,
        at: 0,
    };
    for _ in 0..MAX_STEPS {
        machine.at = machine.stream.position();
        let op = machine.stream.byte()?;
        if op == b'.' {
            let root = machine.pop()?;
            let Machine { nodes, opaque, storages, .. } = machine;
            return Ok(Pickle { nodes, root, opaque, storages });
        }
        machine.step(op)?;
    }
    machine.refuse(format!("a pickle of at most {MAX_STEPS} instructions"), "more")
}

impl Machine<'_, '_> {
    /// Makes an error at the current instruction.
    pub(super) fn bad(&self, expected: impl Into<String>, got: impl Into<String>) -> Error {
        let place = format!(" at byte {}", self.at);
        Error::format(self.stream.path, expected, got).at(place)
    }

    fn refuse<T>(&self, expected: impl Into<String>, got: impl Into<String>) -> Result<T> {
        Err(self.bad(expected, got))
    }

    /// Subtracts `n` nodes from the budget.
    pub(super) fn charge(&mut self, n: usize) -> Result<()> {
        match self.budget.checked_sub(n) {
            Some(left) => self.budget = left,
            None => return self.refuse(format!("at most {MAX_VALUES} values"), "more"),
        }
        Ok(())
    }

    /// Returns the node of an index.
    pub(super) fn node(&self, id: Id) -> &Node {
        self.nodes.get(id as usize).unwrap_or(&Node::None)
    }

    /// Adds a node.
    pub(super) fn make(&mut self, node: Node) -> Result<Id> {
        self.charge(1)?;
        // MAX_VALUES is far below 2^32.
        let id = self.nodes.len() as Id;
        self.nodes.push(node);
        Ok(id)
    }

    fn push(&mut self, id: Id) -> Result<()> {
        if self.stack.len() >= MAX_VALUES {
            return self.refuse(format!("at most {MAX_VALUES} values on the stack"), "more");
        }
        self.stack.push(id);
        Ok(())
    }

    fn push_new(&mut self, node: Node) -> Result<()> {
        let id = self.make(node)?;
        self.push(id)
    }

    /// Pops a value above the innermost mark.
    fn pop(&mut self) -> Result<Id> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.pop() {
            Some(id) if self.stack.len() >= floor => Ok(id),
            _ => self.refuse("a value on the stack", "an empty stack"),
        }
    }

    fn top(&self) -> Result<Id> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.last() {
            Some(id) if self.stack.len() > floor => Ok(*id),
            _ => self.refuse("a value on the stack", "an empty stack"),
        }
    }

    /// Pops all values above the innermost mark, and the mark.
    fn pop_mark(&mut self) -> Result<Vec<Id>> {
        match self.marks.pop() {
            Some(mark) if mark <= self.stack.len() => Ok(self.stack.split_off(mark)),
            _ => self.refuse("a mark on the stack", "none"),
        }
    }

    fn step(&mut self, op: u8) -> Result<()> {
        match op {
            0x80 => {
                let protocol = self.stream.byte()?;
                if !(2..=5).contains(&protocol) {
                    return self.refuse("a pickle of protocol 2 to 5", protocol.to_string());
                }
                Ok(())
            }
            // FRAME: the number of bytes that follow. The stream has bounds of its own.
            0x95 => self.stream.take(8).map(|_| ()),
            b'(' if self.marks.len() >= MAX_MARKS => {
                self.refuse(format!("at most {MAX_MARKS} open containers"), "more")
            }
            b'(' => {
                self.marks.push(self.stack.len());
                Ok(())
            }
            // POP removes a mark on top of the stack.
            b'0' if self.marks.last() == Some(&self.stack.len()) => {
                self.marks.pop();
                Ok(())
            }
            b'0' => self.pop().map(|_| ()),
            b'1' => self.pop_mark().map(|_| ()),
            b'2' => {
                let top = self.top()?;
                self.push(top)
            }
            b'q' | b'r' | 0x94 | b'h' | b'j' => self.memo(op),
            b']' | b'}' | b')' | 0x8f | 0x85..=0x87 | b't' | b'l' | b'd' | 0x91 => {
                self.container(op)
            }
            b'a' | b'e' | b's' | b'u' | 0x90 => self.fill(op),
            b'c' | 0x93 => self.global(op),
            b'R' | 0x81 | 0x92 | b'b' | b'Q' => self.object(op),
            _ => self.literal(op),
        }
    }

    /// Executes BINPUT, LONG_BINPUT, MEMOIZE, BINGET, LONG_BINGET.
    fn memo(&mut self, op: u8) -> Result<()> {
        let index = match op {
            b'q' | b'h' => u32::from(self.stream.byte()?),
            0x94 => self.memo.len() as u32,
            _ => u32::from_le_bytes(self.stream.array()?),
        };
        if matches!(op, b'h' | b'j') {
            let Some(id) = self.memo.get(&index).copied() else {
                return self.refuse("an entry of the memo that was made", format!("{index}"));
            };
            return self.push(id);
        }
        let top = self.top()?;
        if self.memo.len() >= MAX_VALUES {
            return self.refuse(format!("at most {MAX_VALUES} entries of the memo"), "more");
        }
        self.memo.insert(index, top);
        Ok(())
    }

    fn container(&mut self, op: u8) -> Result<()> {
        let node = match op {
            b']' => Node::List(Vec::new()),
            b'}' => Node::Dict(Vec::new()),
            b')' => Node::Tuple(Vec::new()),
            0x8f => Node::Set(Vec::new()),
            0x85..=0x87 => {
                let mut items = Vec::with_capacity(3);
                for _ in 0..op - 0x84 {
                    items.push(self.pop()?);
                }
                items.reverse();
                Node::Tuple(items)
            }
            b't' => Node::Tuple(self.pop_mark()?),
            b'l' => Node::List(self.pop_mark()?),
            b'd' => {
                let flat = self.pop_mark()?;
                Node::Dict(self.pairs(&flat)?)
            }
            _ => Node::Set(self.pop_mark()?),
        };
        self.push_new(node)
    }

    fn pairs(&self, flat: &[Id]) -> Result<Vec<(Id, Id)>> {
        let (pairs, odd) = flat.as_chunks::<2>();
        if !odd.is_empty() {
            return self.refuse("a value for every key", format!("{} items", flat.len()));
        }
        Ok(pairs.iter().map(|[key, value]| (*key, *value)).collect())
    }

    /// Executes APPEND, APPENDS, SETITEM, SETITEMS, ADDITEMS on the container below. An opaque
    /// value drops the items.
    fn fill(&mut self, op: u8) -> Result<()> {
        let items = match op {
            b'a' => vec![self.pop()?],
            b's' => {
                let value = self.pop()?;
                vec![self.pop()?, value]
            }
            _ => self.pop_mark()?,
        };
        let pairs = if matches!(op, b's' | b'u') { self.pairs(&items)? } else { Vec::new() };
        let below = self.top()?;
        match (op, self.nodes.get_mut(below as usize)) {
            (_, Some(Node::Opaque(_))) => Ok(()),
            (b'a' | b'e', Some(Node::List(list))) => {
                list.extend(items);
                Ok(())
            }
            (b's' | b'u', Some(Node::Dict(dict))) => {
                dict.extend(pairs);
                Ok(())
            }
            (0x90, Some(Node::Set(set))) => {
                set.extend(items);
                Ok(())
            }
            _ => self.refuse("a list, dictionary or set to fill", self.kind(below)),
        }
    }

    /// Executes GLOBAL, STACK_GLOBAL.
    fn global(&mut self, op: u8) -> Result<()> {
        let (module, name) = if op == b'c' {
            let line =
                |s: &mut Stream| s.line(MAX_NAME).map(|l| String::from_utf8_lossy(&l).into_owned());
            (line(self.stream)?, line(self.stream)?)
        } else {
            let (name, module) = (self.pop()?, self.pop()?);
            match (self.node(module), self.node(name)) {
                (Node::Str(m), Node::Str(n)) if m.len() <= MAX_NAME && n.len() <= MAX_NAME => {
                    (m.to_string(), n.to_string())
                }
                _ => {
                    let expected = format!("a module and a name of at most {MAX_NAME} bytes");
                    return self.refuse(expected, "another value, or a longer one");
                }
            }
        };
        let full = format!("{module}.{name}");
        if !globals::understood(&full) {
            if self.opaque.len() >= MAX_NAMES {
                return self.refuse(format!("at most {MAX_NAMES} names of classes"), "more");
            }
            self.opaque.insert(full.clone());
        }
        self.push_new(Node::Global(full.into()))
    }

    /// Executes REDUCE, NEWOBJ, NEWOBJ_EX, BUILD, BINPERSID.
    fn object(&mut self, op: u8) -> Result<()> {
        if op == b'b' {
            // BUILD: attributes of an object, `_metadata` of a state_dict; dropped.
            self.pop()?;
            return self.top().map(|_| ());
        }
        let made = if op == b'Q' {
            let id = self.pop()?;
            if let Some(class) = globals::module(self, id) {
                return self.push(class);
            }
            let storage = Arc::new(globals::storage(self, id)?);
            let known = self.storages.entry(storage.key.clone()).or_insert(storage.clone());
            if (&known.kind, known.elements) != (&storage.kind, storage.elements) {
                let got = format!("`{}` twice, with two of them", shown(&storage.key));
                return self.refuse("one size and element type for a storage", got);
            }
            self.make(Node::Storage(storage))?
        } else {
            if op == 0x92 {
                // Keyword arguments: no container and no tensor has any.
                self.pop()?;
            }
            let (arguments, callee) = (self.pop()?, self.pop()?);
            globals::call(self, callee, arguments)?
        };
        self.push(made)
    }

    fn literal(&mut self, op: u8) -> Result<()> {
        let node = match op {
            b'N' => Node::None,
            0x88 => Node::Bool(true),
            0x89 => Node::Bool(false),
            b'K' => Node::Int(i64::from(self.stream.byte()?)),
            b'M' => Node::Int(i64::from(u16::from_le_bytes(self.stream.array()?))),
            b'J' => Node::Int(i64::from(i32::from_le_bytes(self.stream.array()?))),
            0x8a | 0x8b => {
                let length = self.length(if op == 0x8a { 1 } else { 4 })?;
                integer(self.stream.take(length)?)
            }
            b'G' => Node::Float(f64::from_be_bytes(self.stream.array()?)),
            b'X' | 0x8c | 0x8d | b'T' | b'U' => self.text(op)?,
            b'B' | b'C' | 0x8e | 0x96 => {
                let length = self.length(match op {
                    b'B' => 4,
                    b'C' => 1,
                    _ => 8,
                })?;
                Node::Bytes(self.stream.take(length)?.into())
            }
            _ => return self.refuse("an instruction of protocol 2 to 5", unknown(op)),
        };
        self.push_new(node)
    }

    fn text(&mut self, op: u8) -> Result<Node> {
        let length = self.length(match op {
            0x8c | b'U' => 1,
            0x8d => 8,
            _ => 4,
        })?;
        let bytes = self.stream.take(length)?;
        // A string of Python 2 may be any bytes.

        match std::str::from_utf8(bytes) {
            Ok(text) => Ok(Node::Str(text.into())),
            Err(_) if matches!(op, b'T' | b'U') => Ok(Node::Bytes(bytes.into())),
            Err(_) => self.refuse("a text in UTF-8", "other bytes"),
        }
    }

    /// Reads a length of 1, 4 or 8 bytes; the stream compares it with its bounds.
    fn length(&mut self, size: usize) -> Result<usize> {
        let bytes = self.stream.take(size)?;
        let length = bytes.iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
        if length > MAX_PICKLE {
            return self.refuse(format!("at most {MAX_PICKLE} bytes"), format!("{length}"));
        }
        Ok(length as usize)
    }

    /// Describes a node for messages.
    pub(super) fn kind(&self, id: Id) -> String {
        match self.node(id) {
            Node::None => "None".to_owned(),
            Node::Bool(_) => "a bool".to_owned(),
            Node::Int(i) => format!("the integer {i}"),
            Node::Big(_) => "an integer of more than 64 bits".to_owned(),
            Node::Float(_) => "a float".to_owned(),
            Node::Str(s) => format!("the text `{}`", shown(s)),
            Node::Bytes(_) => "bytes".to_owned(),
            Node::List(_) => "a list".to_owned(),
            Node::Tuple(v) => format!("a tuple of {}", v.len()),
            Node::Set(_) => "a set".to_owned(),
            Node::Dict(_) => "a dictionary".to_owned(),
            Node::Global(name) | Node::Opaque(name) => shown(name),
            Node::Storage(_) => "a storage".to_owned(),
            Node::Tensor(_) => "a tensor".to_owned(),
        }
    }
}

/// Decodes LONG1 and LONG4: two's complement, little-endian.
fn integer(bytes: &[u8]) -> Node {
    let negative = bytes.last().is_some_and(|b| *b >= 0x80);
    let (head, rest) = bytes.split_at(bytes.len().min(8));
    let mut word = [if negative { 0xff } else { 0 }; 8];
    for (to, from) in word.iter_mut().zip(head) {
        *to = *from;
    }
    if rest.is_empty() { Node::Int(i64::from_le_bytes(word)) } else { Node::Big(bytes.into()) }
}

/// Describes a refused instruction.
fn unknown(op: u8) -> String {
    match op {
        b'P' | b'I' | b'L' | b'F' | b'S' | b'V' | b'g' | b'p' => {
            format!("`{}`, of the text protocol 0", op as char)
        }
        b'i' | b'o' => format!("`{}`, an object of Python 2", op as char),
        0x82..=0x84 => "a name of the extension registry (EXT)".to_owned(),
        0x97 | 0x98 => "a buffer outside the pickle".to_owned(),
        _ => format!("{op:#04x}"),
    }
}
