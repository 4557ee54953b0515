//! PyTorch files that lie, and files that are none: each is one clear error, without a
//! panic, without running anything, in bounded memory and time.

use subsplat_test_support::torch_writer as writer;

use std::path::Path;
use std::time::{Duration, Instant};
use subsplat::files::weights::torch::{TorchFile, Value};
use writer::*;

/// Opens `bytes` and reads every tensor found, within bounds of time.
fn answer(bytes: Vec<u8>) -> Result<TorchFile, String> {
    let start = Instant::now();
    let result = TorchFile::parse(bytes, "hostile.pt").map_err(|e| e.to_string());
    let result = result.and_then(|file| {
        let mut left = vec![file.root()];
        while let Some(value) = left.pop() {
            if let Some(t) = value.as_tensor() {
                file.read(t).map_err(|e| e.to_string())?;
            }
            left.extend(value.items().unwrap_or_default());
            left.extend(value.entries().map(|(_, v)| v));
        }
        Ok(file)
    });
    assert!(start.elapsed() < Duration::from_secs(60), "took {:?}", start.elapsed());
    if let Err(e) = &result {
        assert!(e.starts_with("hostile.pt") && e.len() < 700 && !e.contains('\n'), "{e}");
        assert!(e.contains("expected ") && e.contains(", got "), "{e}");
    }
    result
}

fn refused(case: &str, bytes: Vec<u8>, words: &[&str]) {
    match answer(bytes) {
        Ok(file) => panic!("{case}: was read as {}", file.root().kind()),
        Err(e) => {
            for word in words {
                assert!(e.contains(word), "{case}: `{word}` is not in: {e}");
            }
        }
    }
}

/// A zip file with this pickle, and one storage of four floats.
fn with_pickle(pickle: &[u8]) -> Vec<u8> {
    zip(&[entry("a/data.pkl", pickle), entry("a/data/0", &[0; 16])])
}

fn with(root: Py) -> Vec<u8> {
    with_pickle(&root.pickle())
}

/// A pickle of protocol 4 around instructions.
fn code(parts: &[&[u8]]) -> Vec<u8> {
    [&[0x80, 4][..], &parts.concat(), b"."].concat()
}

fn floats(offset: i64, shape: &[i64], strides: &[i64]) -> Vec<u8> {
    with(dict(vec![("w", tensor(storage("torch FloatStorage", "0", 4), offset, shape, strides))]))
}

#[test]
fn nothing_is_executed() {
    let marker = std::env::temp_dir().join(format!("subsplat-hostile-{}", std::process::id()));
    let command = format!("touch {}", marker.display());
    let call = |name| Py::Call(name, vec![text(&command)]);
    for name in [
        "os system",
        "posix system",
        "builtins eval",
        "builtins exec",
        "subprocess run",
        "torch load",
        "builtins getattr",
        "torch.storage _load_from_bytes",
    ] {
        let file = answer(with(dict(vec![("x", call(name))]))).unwrap();
        let dotted = name.replace(' ', ".");
        assert_eq!(file.root().get("x"), Some(&Value::Opaque(dotted.as_str().into())));
        assert!(file.opaque_globals().contains(&dotted), "{dotted}");
        // Under a dictionary's, a list's and an object's filling instructions too.
        for filling in [&b"(K\x01K\x02u"[..], b"K\x01a", b"K\x01b", b"(K\x01e", b"K\x01K\x02s"] {
            let mut made = Vec::new();
            made.extend(
                call(name).pickle().strip_suffix(b".").unwrap().strip_prefix(&[0x80, 2]).unwrap(),
            );
            made.extend(filling);
            let file = answer(with(dict(vec![("x", Py::Raw(made))]))).unwrap();
            assert!(matches!(file.root().get("x"), Some(Value::Opaque(_))));
        }
    }
    // A legacy model's class, with its source beside it.
    let source = text("import os; os.system('true')");
    let id = Py::Tuple(vec![text("module"), Py::Global("models Net"), text("net.py"), source]);
    let file = answer(with(Py::List(vec![Py::Persistent(Box::new(id))]))).unwrap();
    assert_eq!(file.root().items().unwrap(), [Value::Opaque("models.Net".into())]);
    assert!(!marker.exists());
}

#[test]
fn an_object_in_the_place_of_a_tensors_part_is_refused() {
    let object = || Py::Call("os system", vec![text("true")]);
    refused("storage", with(tensor(object(), 0, &[1], &[1])), &["a tensor's storage", "os.system"]);
    let odd = |shape: Py, strides: Py| {
        let s = storage("torch FloatStorage", "0", 4);
        with(Py::Call("torch._utils _rebuild_tensor", vec![s, Py::Int(0), shape, strides]))
    };
    refused("shape", odd(object(), ints(&[1])), &["a tensor's shape", "os.system"]);
    refused("size", odd(Py::Tuple(vec![object()]), ints(&[1])), &["a tensor's shape", "os.system"]);
    refused(
        "few",
        with(Py::Call("torch._utils _rebuild_tensor_v2", vec![])),
        &["storage, offset, shape"],
    );
    refused(
        "persistent id",
        with(Py::Persistent(Box::new(text("0")))),
        &["a storage as persistent id"],
    );
    refused(
        "storage class",
        with(storage("os system", "0", 4)),
        &["a type of storage", "os.system"],
    );
    let id = Py::Tuple(vec![text("module"), Py::None, text("0"), text("cpu"), Py::Int(4)]);
    refused("tag", with(Py::Persistent(Box::new(id))), &["a storage as persistent id"]);
}

#[test]
fn tensors_outside_their_storage() {
    let words = ["`w`", "inside its storage of 16 bytes"];
    for (case, offset, shape, strides) in [
        ("too long", 0, &[5][..], &[1][..]),
        ("offset", 1, &[4], &[1]),
        ("offset alone", 4, &[], &[]),
        ("stride", 0, &[2], &[4]),
        ("two strides", 0, &[2, 2], &[2, 2]),
        ("huge stride", 0, &[2], &[i64::MAX]),
        ("huge shape", 0, &[1 << 40, 1 << 40], &[0, 0]),
        ("overflow to four", 0, &[1 << 62, 4], &[0, 0]),
        ("huge offset", i64::MAX, &[1], &[1]),
        ("huge beside none", 0, &[0, i64::MAX, i64::MAX], &[1, 1, 1]),
        ("offset past the end of 63 bits", i64::MAX, &[0], &[1]),
    ] {
        refused(case, floats(offset, shape, strides), &words);
    }
    refused("expanded", floats(0, &[1 << 40], &[0]), &["64 MiB over its storage's"]);
    refused("negative", floats(0, &[-1], &[1]), &["a tensor's shape", "the integer -1"]);
    refused("negative stride", floats(3, &[4], &[-1]), &["a tensor's strides"]);
    refused("negative offset", floats(-1, &[1], &[1]), &["a tensor's offset"]);
    refused("strides", floats(0, &[2, 2], &[1]), &["a stride for each", "1 for 2"]);
    refused("dimensions", floats(0, &[1; 65], &[1; 65]), &["at most 64"]);
    for (case, elements, key, words) in [
        ("shorter", 5, "0", &["5 elements of 4 bytes in storage `0`", "16 bytes"][..]),
        ("longer", 3, "0", &["3 elements", "16 bytes"]),
        ("huge", i64::MAX, "0", &["elements of 4 bytes in storage `0`"]),
        ("negative", -1, "0", &["a storage as persistent id"]),
        ("absent", 4, "1", &["storage `1` in the file", "none"]),
        ("path", 4, "../0", &["storage `../0` in the file", "none"]),
    ] {
        let s = storage("torch FloatStorage", key, elements);
        refused(case, with(dict(vec![("w", tensor(s, 0, &[1], &[1]))])), words);
    }
    let two = ["torch FloatStorage", "torch IntStorage"]
        .map(|c| tensor(storage(c, "0", 4), 0, &[1], &[1]));
    refused("two types", with(Py::List(two.to_vec())), &["one size and element type", "`0`"]);
}

/// Doubling a list of two 40 times over: 2^40 values if it were written out.
fn laughs() -> Vec<u8> {
    let mut parts: Vec<u8> = b"]\x94".to_vec();
    for i in 0..40u8 {
        parts.extend([b']', 0x94, b'(', b'h', i, b'h', i, b'e']);
    }
    code(&[&parts])
}

#[test]
fn bombs_within_the_pickle() {
    refused("billion laughs", with_pickle(&laughs()), &["at most 2097152 values", "shared"]);
    refused(
        "contains itself",
        with_pickle(&code(&[b"]\x94h\0a"])),
        &["64 deep", "contains itself"],
    );
    refused(
        "dictionary in itself",
        with_pickle(&code(&[b"}\x94(\x8c\x01ah\0u"])),
        &["contains itself"],
    );
    refused("tuple in itself", with_pickle(&code(&[b"]\x94h\0\x85a"])), &["contains itself"]);
    refused(
        "deep",
        with_pickle(&code(&[&b"]".repeat(1_000_000), &b"a".repeat(999_999)])),
        &["64 deep"],
    );
    refused("deep tuples", with_pickle(&code(&[b"N", &[0x85].repeat(1_000_000)])), &["64 deep"]);
    refused("open", with_pickle(&code(&[&b"(".repeat(20_000)])), &["at most 10000 open"]);
    refused(
        "many",
        with_pickle(&code(&[b"(", &b"N".repeat(2_200_000), b"t"])),
        &["at most 2097152 values"],
    );
    refused(
        "stack",
        with_pickle(&code(&[b"N", &b"2".repeat(2_200_000)])),
        &["values on the stack"],
    );
    refused(
        "memo",
        with_pickle(&code(&[b"N", &[0x94].repeat(2_200_000)])),
        &["entries of the memo"],
    );
    refused(
        "memo of 2^32",
        with_pickle(&code(&[b"j\xff\xff\xff\xff"])),
        &["an entry of the memo", "4294967295"],
    );
    // Far entries are made as they come: nothing is laid out up to them.
    assert!(answer(with_pickle(&code(&[b"Nr\xff\xff\xff\xffj\xff\xff\xff\xff"]))).is_ok());
    for (case, op) in [("text", 0x8d), ("bytes", 0x8e), ("bytearray", 0x96)] {
        let huge = code(&[&[op], &u64::MAX.to_le_bytes()]);
        refused(case, with_pickle(&huge), &["at most 67108864 bytes", "18446744073709551615"]);
        let beyond = code(&[&[op], &60_000_000u64.to_le_bytes()]);
        refused(case, with_pickle(&beyond), &["60000000 more bytes of pickle", "a wrong length"]);
    }
    refused("long", with_pickle(&code(&[b"\x8b\xff\xff\xff\xff"])), &["at most 67108864 bytes"]);
    // The same entries copied a thousand times, and a long text recoded as often.
    let copies = |callee: &[u8]| {
        let list = [&b"]("[..], &b"N".repeat(100_000), b"e\x94"].concat();
        let calls = [callee, b"h\0\x85R"].concat().repeat(1_000);
        code(&[&list, &calls])
    };
    refused("copies", with_pickle(&copies(b"c__builtin__\nset\n")), &["at most 2097152 values"]);
    refused("deques", with_pickle(&copies(b"ccollections\ndeque\n")), &["at most 2097152 values"]);
    let long =
        [&[0x8d][..], &1_000_000u64.to_le_bytes(), &b"x".repeat(1_000_000), &[0x94]].concat();
    let recode = b"c_codecs\nencode\nh\0\x8c\x06latin1\x86R".repeat(1_000);
    refused("recoded", with_pickle(&code(&[&long, &recode])), &["at most 2097152 values"]);
    let named = b"h\0h\0\x93".repeat(1_000);
    refused("names", with_pickle(&code(&[&long, &named])), &["a name of at most 256 bytes"]);
    let names: Vec<u8> = (0..20_000).flat_map(|i| format!("cm\nn{i}\n").into_bytes()).collect();
    refused("many names", with_pickle(&code(&[&names])), &["at most 10000 names"]);
    refused(
        "line",
        with_pickle(&code(&[b"c", &b"m".repeat(1_000)])),
        &["a line of at most 256 bytes"],
    );
}

#[test]
fn pickles_that_are_none() {
    for (case, bytes, words) in [
        ("empty", &b""[..], &["1 more bytes of pickle", "0 (truncated"][..]),
        ("stops early", b"\x80\x02]", &["1 more bytes of pickle"]),
        ("nothing", b"\x80\x02.", &["a value on the stack"]),
        ("protocol", b"\x80\x09N.", &["protocol 2 to 5", "got 9"]),
        ("text protocol", b"\x80\x02S'x'\n.", &["text protocol 0"]),
        ("instance", b"\x80\x02(ios\nsystem\n.", &["an object of Python 2"]),
        ("extension", b"\x80\x02\x82\x01.", &["extension registry"]),
        ("buffer", b"\x80\x05\x97.", &["a buffer outside the pickle"]),
        ("instruction", b"\x80\x02\xff.", &["an instruction", "0xff"]),
        ("no mark", b"\x80\x02t.", &["a mark on the stack", "none"]),
        ("below the mark", b"\x80\x02N(a.", &["a value on the stack"]),
        ("odd", b"\x80\x02}(Nu.", &["a value for every key", "1 items"]),
        ("fill", b"\x80\x02NNa.", &["a list, dictionary or set to fill", "None"]),
        ("arguments", b"\x80\x02cos\nsystem\nNR.", &["a tuple of arguments", "None"]),
        ("callee", b"\x80\x02N)R.", &["the name of a class or function", "None"]),
        ("keys", b"\x80\x02}(X\x01\0\0\0aNX\x01\0\0\0aNu.", &["`a`", "a key once", "it twice"]),
        ("utf-8", b"\x80\x02X\x01\0\0\0\xff.", &["UTF-8"]),
    ] {
        refused(case, with_pickle(bytes), words);
    }
}

/// A change to the entries of a good file.
type Change = Box<dyn FnOnce(&mut Vec<Entry>)>;

fn changed(change: impl FnOnce(&mut Vec<Entry>)) -> Vec<u8> {
    let mut file = Checkpoint::default();
    let w = file.floats(&[1.0, 2.0], &[2]);
    let mut entries = file.entries(&dict(vec![("w", w)]));
    change(&mut entries);
    zip(&entries)
}

#[test]
fn archives_that_lie() {
    assert!(answer(changed(|_| ())).is_ok());
    let cases: Vec<(&str, Change, &[&str])> = vec![
        (
            "deflated",
            Box::new(|e| e[2].method = 8),
            &["stored entries", "`archive/data/0`", "deflated"],
        ),
        ("bzip2", Box::new(|e| e[2].method = 12), &["stored entries", "method 12"]),
        (
            "encrypted",
            Box::new(|e| e[2].flags |= 1),
            &["plain entries", "`archive/data/0`", "encrypted"],
        ),
        (
            "twice",
            Box::new(|e| e.push(e[2].clone())),
            &["every entry once", "`archive/data/0` twice"],
        ),
        (
            "two folders",
            Box::new(|e| e.push(entry("b/data.pkl", b"N."))),
            &["one data.pkl", "several"],
        ),
        (
            "big-endian",
            Box::new(|e| e[1] = entry("archive/byteorder", b"big")),
            &["little-endian", "`big`"],
        ),
        (
            "other name",
            Box::new(|e| e[2].local_name = Some("archive/data/9".into())),
            &["a local header that agrees", "`archive/data/0`"],
        ),
        ("header elsewhere", Box::new(|e| e[2].offset = Some(1)), &["a local header that agrees"]),
        (
            "header nowhere",
            Box::new(|e| e[2].offset = Some(u64::MAX - 3)),
            &["a local header that agrees"],
        ),
        (
            "overlap",
            Box::new(|e| e[2].size = Some(300)),
            &["entries that do not overlap", "`archive/data/0`, 300 bytes"],
        ),
        ("endless", Box::new(|e| e[2].size = Some(u64::MAX - 8)), &["entries that do not overlap"]),
        (
            "into the directory",
            Box::new(|e| e[3].size = Some(100)),
            &["do not overlap", "`archive/version`"],
        ),
        (
            "short",
            Box::new(|e| e[2] = entry("archive/data/0", &[0; 4])),
            &["2 elements of 4 bytes in storage `0`", "4 bytes"],
        ),
        (
            "smaller size",
            Box::new(|e| e[2].size = Some(4)),
            &["a data descriptor", "4 other bytes after `archive/data/0`"],
        ),
        ("checksum", Box::new(|e| e[2].crc = 5), &["CRC-32 00000005 of storage `0`", "damaged"]),
        (
            "checksum of the pickle",
            Box::new(|e| e[0].crc = 5),
            &["CRC-32 00000005 of data.pkl", "damaged"],
        ),
        ("no pickle", Box::new(|e| drop(e.remove(0))), &["a zip archive without data.pkl"]),
        (
            "up",
            Box::new(|e| e.push(entry("archive/../../etc/passwd", b"x"))),
            &["stay inside the archive", "`archive/../../etc/passwd`"],
        ),
        (
            "absolute",
            Box::new(|e| e.push(entry("/etc/passwd", b"x"))),
            &["stay inside the archive"],
        ),
        ("drive", Box::new(|e| e.push(entry("C:/x", b"x"))), &["stay inside the archive"]),
        (
            "backslash",
            Box::new(|e| e.push(entry("archive\\x", b"x"))),
            &["stay inside the archive"],
        ),
        (
            "control",
            Box::new(|e| e.push(entry("archive/\n\u{1b}[2J", b"x"))),
            &["stay inside the archive", "\\n"],
        ),
        ("no name", Box::new(|e| e.push(entry("", b"x"))), &["stay inside the archive"]),
        (
            "TorchScript",
            Box::new(|e| e.push(entry("archive/constants.pkl", b"x"))),
            &["a TorchScript archive", "state_dict()"],
        ),
        (
            "TorchScript code",
            Box::new(|e| e.push(entry("archive/code/a.py", b"x"))),
            &["a TorchScript archive"],
        ),
        ("npz", Box::new(|e| *e = vec![entry("a.npy", b"x")]), &["NumPy's .npz archive"]),
    ];
    for (case, change, words) in cases {
        refused(case, changed(change), words);
    }
}

/// Every number of the end records and every length of the directory, changed.
#[test]
fn end_records_that_lie() {
    let good = changed(|_| ());
    let end = good.len() - 22;
    let (locator, record) = (end - 20, end - 20 - 56);
    let size = u64::from_le_bytes(good[record + 40..][..8].try_into().unwrap());
    let directory = record - size as usize;
    for (case, at, length, words) in [
        ("entries", record + 32, 8, "a central directory"),
        ("size", record + 40, 8, "a central directory"),
        ("offset", record + 48, 8, "a central directory"),
        ("disks", record + 16, 4, "split zip archive"),
        ("record's size", record + 4, 8, "a locator of another place"),
        ("locator", locator + 8, 8, "expected "),
        ("comment", end + 20, 2, "a zip archive's end record"),
        ("signature", end, 1, "a zip archive's end record"),
        ("directory's signature", directory, 1, "an entry of the central directory"),
        ("name's length", directory + 28, 2, "an entry of the central directory"),
        ("extra's length", directory + 30, 2, "an entry of the central directory"),
        ("header's offset", directory + 42, 4, "a zip64 field"),
    ] {
        for fill in [0xffu8, 0x7f] {
            let mut bytes = good.clone();
            bytes[at..at + length].fill(fill);
            // 0x7fffffff is an offset of no header rather than zip64's sentinel.
            let words =
                if case == "header's offset" && fill == 0x7f { "a local header" } else { words };
            refused(case, bytes, &[words]);
        }
    }
    let mut fewer = good.clone();
    fewer[record + 32] -= 1;
    refused("one entry fewer", fewer, &["a central directory of its entries alone"]);
}

/// Every prefix of a good file of each form, and every byte of it changed: each gives a
/// result or an error.
#[test]
fn truncated_and_damaged_files_are_answered() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/torch");
    for name in ["protocol4_legacy.pt", "views_legacy.pt", "views.pt", "protocol5.pt"] {
        let good = std::fs::read(folder.join(name)).unwrap();
        assert!(answer(good.clone()).is_ok());
        for length in 0..good.len() {
            assert!(answer(good[..length].to_vec()).is_err(), "{name} of {length} bytes");
        }
        for more in [&b"\0"[..], b"\xff", b"PK\x05\x06", &good] {
            let longer = [&good[..], more].concat();
            assert!(answer(longer).is_err(), "{name} and {} bytes more", more.len());
        }
        for at in 0..good.len() {
            for value in [0xff, good[at] ^ 1] {
                let mut bytes = good.clone();
                bytes[at] = value;
                let _ = answer(bytes);
            }
        }
    }
}

/// Every bit of the entries' data: each has a checksum, those of views too.
#[test]
fn every_bit_of_an_archive_is_checked() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/torch");
    for name in ["views.pt", "dtypes.pt"] {
        let good = std::fs::read(folder.join(name)).unwrap();
        let end = good.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
        let mut unread = Vec::new();
        for at in 0..end {
            let mut bytes = good.clone();
            bytes[at] ^= 1;
            if answer(bytes).is_ok() {
                unread.push(at);
            }
        }
        // Padding and fields of local headers that repeat the directory: no data.
        let data = |at: usize| {
            let starts = good.windows(4).enumerate().filter(|(_, w)| *w == b"PK\x03\x04");
            let header = starts.map(|(i, _)| i).take_while(|i| *i <= at).last().unwrap();
            let length =
                |o: usize| usize::from(good[header + o]) + 256 * usize::from(good[header + o + 1]);
            at >= header + 30 + length(26) + length(28)
        };
        let lost: Vec<_> = unread.into_iter().filter(|at| data(*at)).collect();
        assert!(lost.is_empty(), "{name}: changed and read all the same: {lost:?}");
    }
}

/// Bytes between two entries are a data descriptor that repeats the directory, or nothing.
#[test]
fn bytes_between_entries_are_an_error() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/torch");
    let good = std::fs::read(folder.join("views.pt")).unwrap();
    let descriptor = good.windows(4).position(|w| w == b"PK\x07\x08").unwrap();
    for at in descriptor..descriptor + 16 {
        let mut bytes = good.clone();
        bytes[at] ^= 1;
        refused("descriptor", bytes, &["a data descriptor"]);
    }
    let entries = [entry("a/data.pkl", &dict(vec![]).pickle()), entry("a/version", b"3\n")];
    assert!(answer(zip(&entries)).is_ok());
    // Longer by a byte that no entry has: the second one starts later than it could.
    let mut holed = Vec::new();
    let mut first = entries[0].clone();
    if let Data::Bytes(data) = &mut first.data {
        first.size = Some(data.len() as u64);
        data.push(b'.');
    }
    write_zip(&mut std::io::Cursor::new(&mut holed), &[first, entries[1].clone()]).unwrap();
    refused("hole", holed, &["a data descriptor"]);
    // A pickle that ends before its entry does.
    let longer = [&dict(vec![]).pickle()[..], b"."].concat();
    refused("pickle", zip(&[entry("a/data.pkl", &longer)]), &["the end of the pickle"]);
}

#[test]
fn other_files_are_named() {
    let mut tar = vec![b'x'; 1024];
    tar[257..262].copy_from_slice(b"ustar");
    tar[..9].copy_from_slice(b"sys_info\0");
    let safetensors = [&20u64.to_le_bytes()[..], b"{\"__metadata__\":{}}   "].concat();
    for (bytes, words) in [
        (Vec::new(), "an empty file"),
        (b"\x89PNG\r\n\x1a\n0000".to_vec(), "a PNG picture"),
        (b"\xff\xd8\xff\xe0\0\x10JFIF".to_vec(), "a JPEG picture"),
        (b"\x1f\x8b\x08\0".to_vec(), "a gzip file"),
        (tar, "PyTorch's oldest form"),
        (safetensors, "a safetensors file, which needs no conversion"),
        (b"\x93NUMPY\x01\0".to_vec(), ".npy"),
        (b"version https://git-lfs.github.com/spec/v1\n".to_vec(), "a Git LFS pointer"),
        (b"<!doctype html><html>".to_vec(), "text"),
        (dict(vec![]).pickle(), "a plain pickle, not written by torch.save"),
        (vec![0; 64], "the bytes 00 00"),
        (b"PK\x05\x06".to_vec(), "an empty zip archive"),
        (b"PK\x03\x04 and no more".to_vec(), "truncated download"),
        (b"\x80".to_vec(), "the bytes 80"),
    ] {
        refused(
            words,
            bytes,
            &["a file of torch.save", words][if words.contains("truncated") { 1 } else { 0 }..],
        );
    }
    let jit = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/torch/torchscript.pt");
    assert!(TorchFile::open(&jit).unwrap_err().to_string().contains("a TorchScript archive"));
    let folder = TorchFile::open(env!("CARGO_MANIFEST_DIR")).unwrap_err().to_string();
    assert!(folder.contains("a folder"), "{folder}");
    assert!(TorchFile::open("no/such.pt").unwrap_err().to_string().contains("no/such.pt"));
}

/// A legacy file: the object's pickle, the keys, then what stands behind them.
fn legacy(little: bool, root: Py, keys: &[&str], behind: &[u8]) -> Vec<u8> {
    let magic = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.";
    let keys = Py::List(keys.iter().map(|k| text(k)).collect());
    let system = dict(vec![("little_endian", Py::Bool(little))]);
    [&magic[..], b"\x80\x02M\xe9\x03.", &system.pickle(), &root.pickle(), &keys.pickle(), behind]
        .concat()
}

#[test]
fn legacy_files_that_lie() {
    let data = [&2u64.to_le_bytes()[..], &[0; 8]].concat();
    let root = || dict(vec![("w", tensor(storage("torch FloatStorage", "k", 2), 0, &[2], &[1]))]);
    assert!(answer(legacy(true, root(), &["k"], &data)).is_ok());
    refused("big-endian", legacy(false, root(), &["k"], &data), &["little-endian", "big-endian"]);
    refused("no keys", legacy(true, root(), &[], &[]), &["storage `k` in the file"]);
    refused("other key", legacy(true, root(), &["x"], &data), &["a tensor of storage `x`"]);
    refused(
        "twice",
        legacy(true, root(), &["k", "k"], &data.repeat(2)),
        &["every storage once", "`k` twice"],
    );
    refused(
        "count",
        legacy(true, root(), &["k"], &3u64.to_le_bytes()),
        &["2 elements in storage `k`", "3 before"],
    );
    refused(
        "short",
        legacy(true, root(), &["k"], &data[..12]),
        &["2 elements in storage `k`", "truncated"],
    );
    refused("nothing", legacy(true, root(), &["k"], &[]), &["8 bytes at byte", "truncated"]);
    let longer = [&data[..], b"\0"].concat();
    refused("more", legacy(true, root(), &["k"], &longer), &["the end of the file", "1 more"]);
    let endless =
        dict(vec![("w", tensor(storage("torch FloatStorage", "k", i64::MAX), 0, &[2], &[1]))]);
    refused(
        "endless",
        legacy(true, endless, &["k"], &(i64::MAX as u64).to_le_bytes()),
        &["elements in storage `k`"],
    );
    let view = |first: i64, elements: i64| {
        let part = Py::Tuple(vec![text("v"), Py::Int(first), Py::Int(elements)]);
        let id = [
            text("storage"),
            Py::Global("torch FloatStorage"),
            text("k"),
            text("cpu"),
            Py::Int(2),
            part,
        ];
        let s = Py::Persistent(Box::new(Py::Tuple(id.to_vec())));
        legacy(
            true,
            dict(vec![("w", tensor(s, 0, &[1], &[1]))]),
            &["k"],
            &[&2u64.to_le_bytes()[..], &1f32.to_le_bytes(), &5f32.to_le_bytes()].concat(),
        )
    };
    let file = answer(view(1, 1)).unwrap();
    let t = file.root().get("w").unwrap().as_tensor().unwrap();
    assert_eq!(file.read(t).unwrap(), 5f32.to_le_bytes());
    refused("view", view(1, 2), &["a view inside storage `k` of 8 bytes", "2 elements from 1"]);
    refused("huge view", view(i64::MAX, i64::MAX), &["a view inside storage"]);
    refused("keys", legacy(true, root(), &[], &[]).into_iter().take(200).collect(), &["expected"]);
    let protocol =
        [&b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19."[..], b"\x80\x02M\xe8\x03."]
            .concat();
    refused("protocol", protocol, &["protocol 1001"]);
}
