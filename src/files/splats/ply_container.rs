//! The PLY container: header, elements, rows of numbers; ascii and binary of either byte
//! order. It is read as a stream, so that a file is not in memory twice.
//!
//! Declared counts are compared with the remaining bytes before anything is allocated. Bytes after
//! the last element are not read, and a note gives their number. The types `half` and `float16`
//! are read beside the eight of the format: trainers that compress their scenes declare them.
//! Source: Turk, "The PLY Polygon File Format".

use crate::files::{Error, Result};
use half::f16;
use std::io::{BufRead, Read};
use std::path::Path;

/// Longest header line, and longest row of an ascii file, bytes.
const LINE_MAX: u64 = 1 << 16;
/// Longest header, bytes.
const HEADER_MAX: u64 = 1 << 20;
/// Rows per read.
const BLOCK_ROWS: u64 = 1024;

/// A stream of a known length.
pub(super) struct Source<'a> {
    reader: &'a mut dyn BufRead,
    left: u64,
    line: usize,
    /// Name of the file, for errors.
    pub path: &'a Path,
}

impl<'a> Source<'a> {
    /// Makes a source of exactly `length` bytes.
    pub fn new(reader: &'a mut dyn BufRead, length: u64, path: &'a Path) -> Self {
        Self { reader, left: length, line: 0, path }
    }

    fn fill(&mut self, buffer: &mut [u8]) -> Result<()> {
        if buffer.len() as u64 > self.left {
            return Err(self.short(buffer.len() as u64));
        }
        self.reader.read_exact(buffer).map_err(|e| Error::io(self.path, e))?;
        self.left -= buffer.len() as u64;
        Ok(())
    }

    fn short(&self, needed: u64) -> Error {
        let expected = format!("{needed} more bytes of data");
        Error::format(self.path, expected, format!("{}: the file is cut short", self.left))
    }

    /// Reads one line and drops its end. A line without an end is an error, since a number
    /// at its end may have lost digits.
    fn line(&mut self, what: &str) -> Result<Vec<u8>> {
        let mut line = Vec::new();
        let mut limited = Read::take(&mut *self.reader, LINE_MAX.min(self.left));
        limited.read_until(b'\n', &mut line).map_err(|e| Error::io(self.path, e))?;
        self.line += 1;
        self.left -= line.len() as u64;
        if line.last() != Some(&b'\n') {
            let got = if line.is_empty() {
                "the end of the file".to_owned()
            } else if self.left == 0 {
                "the end of the file within the line (no line end: cut short?)".to_owned()
            } else {
                format!("a line of more than {LINE_MAX} bytes")
            };
            return Err(Error::format(self.path, what, got).at(format!(":{}", self.line)));
        }
        while matches!(line.last(), Some(b'\n' | b'\r')) {
            line.pop();
        }
        Ok(line)
    }

    /// Makes a note of the bytes after the last element, which are not read; blank lines may follow
    /// the rows of an ascii file.
    pub fn finish(&mut self, encoding: Encoding) -> Result<Option<String>> {
        let mut after = self.left;
        while encoding == Encoding::Ascii && self.left > 0 {
            let mut line = Vec::new();
            let mut limited = Read::take(&mut *self.reader, LINE_MAX.min(self.left));
            limited.read_until(b'\n', &mut line).map_err(|e| Error::io(self.path, e))?;
            if line.is_empty() || !line.iter().all(u8::is_ascii_whitespace) {
                break;
            }
            self.left -= line.len() as u64;
            after = self.left;
        }
        Ok((after > 0).then(|| {
            format!("{after} bytes after the last row that the header announces are not read")
        }))
    }

    fn bad_line(&self, expected: impl Into<String>, got: &[u8]) -> Error {
        let text: String = String::from_utf8_lossy(got).chars().take(80).collect();
        Error::format(self.path, expected, format!("{text:?}")).at(format!(":{}", self.line))
    }
}

/// A number type of PLY.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    /// IEEE 754 binary16, which the PLY of Turk lacks.
    F16,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "half" | "float16" => Self::F16,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Bytes in a binary file.
    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 | Self::F16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Decodes the value of the first `size` bytes of `b`; an f64 holds every u32 and f32
    /// exactly.
    fn value(self, b: &[u8], encoding: Encoding) -> f64 {
        fn word<const N: usize>(b: &[u8], encoding: Encoding) -> [u8; N] {
            let mut w = [0; N];
            w.copy_from_slice(&b[..N]);
            if encoding == Encoding::Big {
                w.reverse();
            }
            w
        }
        match self {
            Self::I8 => f64::from(b[0] as i8),
            Self::U8 => f64::from(b[0]),
            Self::I16 => f64::from(i16::from_le_bytes(word(b, encoding))),
            Self::U16 => f64::from(u16::from_le_bytes(word(b, encoding))),
            Self::I32 => f64::from(i32::from_le_bytes(word(b, encoding))),
            Self::U32 => f64::from(u32::from_le_bytes(word(b, encoding))),
            Self::F16 => f64::from(f16::from_le_bytes(word(b, encoding))),
            Self::F32 => f64::from(f32::from_le_bytes(word(b, encoding))),
            Self::F64 => f64::from_le_bytes(word(b, encoding)),
        }
    }
}

/// A property of an element.
pub(super) struct Property {
    /// Name in the header.
    pub name: String,
    /// Type of the value, or of a list's items.
    pub kind: Scalar,
    /// Type of the length of a list; `None` for a scalar.
    list: Option<Scalar>,
}

/// An element of the header.
pub(super) struct Element {
    /// `vertex`, `chunk`, `face`, …
    pub name: String,
    /// Declared number of rows; [`Header::checked_count`] compares it with the bytes.
    pub count: u64,
    /// Properties in the order of the file.
    pub properties: Vec<Property>,
}

impl Element {
    /// Returns the index of the scalar property `name`.
    pub fn position(&self, name: &str) -> Option<usize> {
        self.properties.iter().position(|p| p.name == name && p.list.is_none())
    }

    fn has_lists(&self) -> bool {
        self.properties.iter().any(|p| p.list.is_some())
    }

    /// Returns the smallest number of bytes of a row.
    fn row_bytes_min(&self, encoding: Encoding) -> u64 {
        let least = |p: &Property| p.list.unwrap_or(p.kind).size();
        match encoding {
            // A digit and a separator.
            Encoding::Ascii => 2 * self.properties.len() as u64,
            _ => self.properties.iter().map(|p| least(p) as u64).sum(),
        }
    }
}

/// Encoding of the rows: text, or a byte order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    Little,
    Big,
}

impl Encoding {
    /// Returns the header's word for the encoding.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ascii => "ascii",
            Self::Little => "binary_little_endian",
            Self::Big => "binary_big_endian",
        }
    }
}

/// The header of a file.
pub(super) struct Header {
    pub encoding: Encoding,
    pub elements: Vec<Element>,
    /// `comment` and `obj_info` lines, without those words.
    pub comments: Vec<String>,
}

impl Header {
    /// Reads up to and including `end_header`.
    pub fn read(source: &mut Source) -> Result<Self> {
        let magic = source.line("`ply`")?;
        if magic != b"ply" {
            return Err(source.bad_line("`ply`", &magic));
        }
        let start = source.left;
        let mut encoding = None;
        let mut elements = Vec::<Element>::new();
        let mut comments = Vec::new();
        loop {
            let line = source.line("a header line or `end_header`")?;
            if start - source.left > HEADER_MAX {
                let got = format!("no `end_header` in {HEADER_MAX} bytes");
                return Err(Error::format(source.path, "a PLY header", got));
            }
            let lossy = String::from_utf8_lossy(&line);
            let mut words = lossy.split_ascii_whitespace();
            match words.next() {
                None => {}
                Some("comment" | "obj_info") => {
                    let (_, text) = lossy.trim_start().split_once(' ').unwrap_or(("", ""));
                    comments.push(text.trim().to_owned());
                }
                Some("format") => encoding = Some(read_format(source, &line, words)?),
                Some("element") => elements.push(read_element(source, &line, words)?),
                Some("property") => {
                    let property = read_property(source, &line, words)?;
                    let Some(element) = elements.last_mut() else {
                        return Err(source.bad_line("`element` before the first property", &line));
                    };
                    if element.properties.iter().any(|p| p.name == property.name) {
                        return Err(source.bad_line("each property once", &line));
                    }
                    element.properties.push(property);
                }
                Some("end_header") => break,
                Some(_) => {
                    let expected = "format, element, property, comment, obj_info or end_header";
                    return Err(source.bad_line(expected, &line));
                }
            }
        }
        let encoding = encoding.ok_or_else(|| {
            Error::format(source.path, "a `format` line in the PLY header", "none")
        })?;
        Ok(Self { encoding, elements, comments })
    }

    /// Returns the number of rows of `element`, after a comparison with the remaining bytes.
    pub fn checked_count(&self, element: &Element, source: &Source) -> Result<usize> {
        let least = element.row_bytes_min(self.encoding);
        let needed = u128::from(least) * u128::from(element.count);
        if needed > u128::from(source.left) {
            let expected = format!(
                "{} rows of `{}`, at least {needed} bytes, as the header says",
                element.count, element.name
            );
            return Err(Error::format(source.path, expected, format!("{} bytes", source.left)));
        }
        usize::try_from(element.count).map_err(|_| {
            Error::format(source.path, "a count that fits memory", element.count.to_string())
        })
    }

    /// Calls `each(row, values)` for every row of `element`; the value of a list is NaN.
    pub fn rows(
        &self,
        element: &Element,
        source: &mut Source,
        mut each: impl FnMut(usize, &[f64]) -> Result<()>,
    ) -> Result<()> {
        let count = self.checked_count(element, source)?;
        if element.properties.is_empty() {
            return Ok(());
        }
        let mut values = vec![f64::NAN; element.properties.len()];
        if self.encoding == Encoding::Ascii {
            for i in 0..count {
                ascii_row(element, source, &mut values)?;
                each(i, &values)?;
            }
            return Ok(());
        }
        if element.has_lists() {
            for i in 0..count {
                list_row(element, source, self.encoding, &mut values)?;
                each(i, &values)?;
            }
            return Ok(());
        }
        let stride = element.row_bytes_min(self.encoding) as usize;
        let mut block = vec![0; stride * (count as u64).min(BLOCK_ROWS) as usize];
        for first in (0..count).step_by(BLOCK_ROWS as usize) {
            let rows = (count - first).min(BLOCK_ROWS as usize);
            let bytes = &mut block[..rows * stride];
            source.fill(bytes)?;
            for (i, row) in bytes.chunks_exact(stride).enumerate() {
                let mut at = 0;
                for (v, p) in values.iter_mut().zip(&element.properties) {
                    *v = p.kind.value(&row[at..], self.encoding);
                    at += p.kind.size();
                }
                each(first + i, &values)?;
            }
        }
        Ok(())
    }
}

type Words<'a> = std::str::SplitAsciiWhitespace<'a>;

fn read_format(source: &Source, line: &[u8], mut words: Words) -> Result<Encoding> {
    match (words.next(), words.next()) {
        (Some("ascii"), Some("1.0")) => Ok(Encoding::Ascii),
        (Some("binary_little_endian"), Some("1.0")) => Ok(Encoding::Little),
        (Some("binary_big_endian"), Some("1.0")) => Ok(Encoding::Big),
        _ => Err(source.bad_line(
            "format ascii, binary_little_endian or binary_big_endian, version 1.0",
            line,
        )),
    }
}

fn read_element(source: &Source, line: &[u8], mut words: Words) -> Result<Element> {
    let name = words.next().map(str::to_owned);
    let count = words.next().and_then(|w| w.parse().ok());
    match (name, count) {
        (Some(name), Some(count)) => Ok(Element { name, count, properties: Vec::new() }),
        _ => Err(source.bad_line("`element NAME COUNT`", line)),
    }
}

fn read_property(source: &Source, line: &[u8], mut words: Words) -> Result<Property> {
    let bad = || source.bad_line("`property TYPE NAME` or `property list TYPE TYPE NAME`", line);
    if std::str::from_utf8(line).is_err() {
        return Err(source.bad_line("a property name in UTF-8", line));
    }
    let scalar = |w: Option<&str>| w.and_then(Scalar::parse).ok_or_else(bad);
    let first = words.next();
    let (list, kind) = if first == Some("list") {
        let length = scalar(words.next())?;
        if matches!(length, Scalar::F16 | Scalar::F32 | Scalar::F64) {
            return Err(source.bad_line("an integer type for a list's length", line));
        }
        (Some(length), scalar(words.next())?)
    } else {
        (None, scalar(first)?)
    };
    let name = words.next().ok_or_else(bad)?.to_owned();
    Ok(Property { name, kind, list })
}

fn ascii_row(element: &Element, source: &mut Source, values: &mut [f64]) -> Result<()> {
    let mut line = source.line("a row of numbers")?;
    while line.iter().all(u8::is_ascii_whitespace) {
        line = source.line("a row of numbers")?;
    }
    let text = std::str::from_utf8(&line).map_err(|_| source.bad_line("numbers", &line))?;
    let mut words = text.split_ascii_whitespace();
    let mut next = |what: &str| -> Result<f64> {
        let word = words.next().ok_or_else(|| source.bad_line(format!("`{what}`"), &line))?;
        word.parse().map_err(|_| source.bad_line(format!("a number for `{what}`"), word.as_bytes()))
    };
    for (v, p) in values.iter_mut().zip(&element.properties) {
        *v = next(&p.name)?;
        if p.list.is_some() {
            // The line is bounded: a wrong length runs out of words soon.
            let length = *v;
            if !(length >= 0.0 && length.fract() == 0.0) {
                return Err(source.bad_line(format!("a length for `{}`", p.name), &line));
            }
            let mut left = length;
            while left > 0.0 {
                next(&p.name)?;
                left -= 1.0;
            }
            *v = f64::NAN;
        }
    }
    if words.next().is_some() {
        let expected = format!("the {} properties of `{}`", values.len(), element.name);
        return Err(source.bad_line(expected, &line));
    }
    Ok(())
}

fn list_row(
    element: &Element,
    source: &mut Source,
    encoding: Encoding,
    values: &mut [f64],
) -> Result<()> {
    let mut word = [0u8; 8];
    for (v, p) in values.iter_mut().zip(&element.properties) {
        let head = p.list.unwrap_or(p.kind);
        source.fill(&mut word[..head.size()])?;
        *v = head.value(&word, encoding);
        if p.list.is_some() {
            let length = std::mem::replace(v, f64::NAN);
            if length < 0.0 {
                let got = format!("{length}");
                return Err(Error::format(source.path, format!("a length for `{}`", p.name), got));
            }
            // No overflow: at most 2³² items of 8 bytes.
            let mut skip = length as u64 * p.kind.size() as u64;

            if skip > source.left {
                return Err(source.short(skip));
            }
            let mut waste = [0u8; 256];
            while skip > 0 {
                let n = skip.min(256) as usize;
                source.fill(&mut waste[..n])?;
                skip -= n as u64;
            }
        }
    }
    Ok(())
}
