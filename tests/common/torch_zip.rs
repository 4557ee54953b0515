//! Files as `torch.save` writes them (zip form, pickle protocol 2), for tests that need
//! ones larger than what should be committed.
#![allow(dead_code, reason = "not every test binary uses every helper")]

/// What can be saved.
pub enum Item {
    None,
    Int(i32),
    Float(f64),
    Text(String),
    List(Vec<Item>),
    Dict(Vec<(String, Item)>),
    /// `OrderedDict` with the attribute `_metadata` that `Module.state_dict` gives it.
    StateDict(Vec<(String, Item)>),
    /// Storage class, shape, little-endian elements.
    Tensor(&'static str, Vec<usize>, Vec<u8>),
    /// An object of a class: module and name.
    Object(&'static str, &'static str),
}

/// An f32 tensor.
pub fn floats(shape: &[usize], values: &[f32]) -> Item {
    assert_eq!(shape.iter().product::<usize>(), values.len());
    let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    Item::Tensor("FloatStorage", shape.to_vec(), bytes)
}

/// The bytes of the file.
pub fn saved(root: &Item) -> Vec<u8> {
    let mut pickle = Pickle { code: vec![0x80, 2], storages: Vec::new() };
    pickle.put(root);
    pickle.code.push(b'.');
    let mut zip = Zip::default();
    zip.add("archive/data.pkl", &pickle.code);
    zip.add("archive/byteorder", b"little");
    for (i, storage) in pickle.storages.iter().enumerate() {
        zip.add(&format!("archive/data/{i}"), storage);
    }
    zip.add("archive/version", b"3\n");
    zip.finish()
}

struct Pickle<'a> {
    code: Vec<u8>,
    storages: Vec<&'a [u8]>,
}

impl<'a> Pickle<'a> {
    fn put(&mut self, item: &'a Item) {
        match item {
            Item::None => self.code.push(b'N'),
            Item::Int(i) => self.int(*i),
            Item::Float(f) => {
                self.code.push(b'G');
                self.code.extend(f.to_be_bytes());
            }
            Item::Text(s) => self.text(s),
            Item::List(items) => {
                self.code.extend(b"](");
                items.iter().for_each(|i| self.put(i));
                self.code.push(b'e');
            }
            Item::Dict(entries) => {
                self.code.push(b'}');
                self.entries(entries);
            }
            Item::StateDict(entries) => {
                self.empty_ordered();
                self.entries(entries);
                self.code.push(b'}');
                self.text("_metadata");
                self.empty_ordered();
                self.code.extend(b"sb");
            }
            Item::Tensor(storage, shape, bytes) => self.tensor(storage, shape, bytes),
            Item::Object(module, name) => {
                self.global(module, name);
                self.code.extend(b")R");
            }
        }
    }

    fn entries(&mut self, entries: &'a [(String, Item)]) {
        self.code.push(b'(');
        for (key, value) in entries {
            self.text(key);
            self.put(value);
        }
        self.code.push(b'u');
    }

    fn tensor(&mut self, storage: &str, shape: &[usize], bytes: &'a [u8]) {
        let elements: usize = shape.iter().product();
        self.global("torch._utils", "_rebuild_tensor_v2");
        self.code.extend(b"((");
        self.text("storage");
        self.global("torch", storage);
        self.text(&self.storages.len().to_string());
        self.text("cuda:0");
        self.int(elements as i32);
        self.code.extend(b"tQ");
        self.storages.push(bytes);
        self.int(0);
        self.tuple(shape);
        let strides: Vec<usize> =
            (0..shape.len()).map(|i| shape[i + 1..].iter().product()).collect();
        self.tuple(&strides);
        self.code.push(0x89);
        self.empty_ordered();
        self.code.extend(b"tR");
    }

    fn tuple(&mut self, numbers: &[usize]) {
        self.code.push(b'(');
        numbers.iter().for_each(|n| self.int(*n as i32));
        self.code.push(b't');
    }

    fn empty_ordered(&mut self) {
        self.global("collections", "OrderedDict");
        self.code.extend(b")R");
    }

    fn global(&mut self, module: &str, name: &str) {
        self.code.extend(format!("c{module}\n{name}\n").bytes());
    }

    fn text(&mut self, text: &str) {
        self.code.push(b'X');
        self.code.extend((text.len() as u32).to_le_bytes());
        self.code.extend(text.bytes());
    }

    fn int(&mut self, i: i32) {
        self.code.push(b'J');
        self.code.extend(i.to_le_bytes());
    }
}

#[derive(Default)]
struct Zip {
    bytes: Vec<u8>,
    directory: Vec<u8>,
    entries: u16,
}

impl Zip {
    /// Stored, not compressed, as PyTorch does.
    fn add(&mut self, name: &str, data: &[u8]) {
        let mut crc = flate2::Crc::new();
        crc.update(data);
        let at = self.bytes.len() as u32;
        // From "version needed" to the length of the extra field: the same in both places.
        let mut common = vec![20, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        common.extend(crc.sum().to_le_bytes());
        common.extend((data.len() as u32).to_le_bytes());
        common.extend((data.len() as u32).to_le_bytes());
        common.extend((name.len() as u16).to_le_bytes());
        common.extend([0, 0]);
        self.bytes.extend(b"PK\x03\x04");
        self.bytes.extend(&common);
        self.bytes.extend(name.bytes());
        self.bytes.extend(data);
        self.directory.extend(b"PK\x01\x02\x14\x00");
        self.directory.extend(&common);
        // Comment, disk, attributes.
        self.directory.extend([0; 10]);
        self.directory.extend(at.to_le_bytes());
        self.directory.extend(name.bytes());
        self.entries += 1;
    }

    fn finish(mut self) -> Vec<u8> {
        let at = self.bytes.len() as u32;
        self.bytes.extend(&self.directory);
        self.bytes.extend(b"PK\x05\x06\0\0\0\0");
        self.bytes.extend(self.entries.to_le_bytes());
        self.bytes.extend(self.entries.to_le_bytes());
        self.bytes.extend((self.directory.len() as u32).to_le_bytes());
        self.bytes.extend(at.to_le_bytes());
        self.bytes.extend([0, 0]);
        self.bytes
    }
}
