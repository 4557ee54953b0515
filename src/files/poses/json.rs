//! JSON as programs write it: with a byte order mark, in UTF-16 (PowerShell's `>`), and with `NaN` and
//! `Infinity`, which JSON lacks.

use super::super::{Error, Result};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer};
use std::borrow::Cow;
use std::path::Path;

/// UTF-8's byte order mark.
const MARK: &[u8] = b"\xEF\xBB\xBF";
/// UTF-16's byte order marks, little-endian and big-endian.
const MARKS_16: [&[u8]; 2] = [b"\xFF\xFE", b"\xFE\xFF"];
/// Numbers that JSON lacks, as Python and C++ write them.
const NOT_NUMBERS: [&str; 6] = ["-Infinity", "Infinity", "-inf", "inf", "NaN", "nan"];

/// Reads `bytes` of `path`, which should be `expected`.
///
/// # Errors
/// Malformed JSON, or JSON of another layout; the error has line and column.
pub(super) fn parse<T: DeserializeOwned>(path: &Path, bytes: &[u8], expected: &str) -> Result<T> {
    serde_json::from_slice(&clean(bytes)).map_err(|e| error(path, expected, &e))
}

/// Any JSON.
pub(super) fn value(bytes: &[u8]) -> serde_json::Result<serde_json::Value> {
    serde_json::from_slice(&clean(bytes))
}

/// Reports whether JSON is a list.
pub(super) fn is_list(bytes: &[u8]) -> bool {
    utf8(bytes).iter().find(|b| !b.is_ascii_whitespace()) == Some(&b'[')
}

/// Deserializes numbers; what is no number in JSON is not a number.
pub(super) fn numbers<'de, D: Deserializer<'de>>(
    from: D,
) -> std::result::Result<Vec<f64>, D::Error> {
    let row = Vec::<Option<f64>>::deserialize(from)?;
    Ok(row.into_iter().map(|v| v.unwrap_or(f64::NAN)).collect())
}

/// Deserializes rows of numbers; what is no number in JSON is not a number.
pub(super) fn rows<'de, D: Deserializer<'de>>(
    from: D,
) -> std::result::Result<Vec<Vec<f64>>, D::Error> {
    let rows = Vec::<Vec<Option<f64>>>::deserialize(from)?;
    let numbers = |row: Vec<Option<f64>>| row.into_iter().map(|v| v.unwrap_or(f64::NAN)).collect();
    Ok(rows.into_iter().map(numbers).collect())
}

/// A number, or the text of one, as boost's property trees have it; `None` for anything else.
pub(super) fn number_of(value: &serde_json::Value) -> Option<f64> {
    value.as_f64().or_else(|| value.as_str()?.trim().parse().ok())
}

/// Makes an error of a JSON error, with its line and column; serde's message has the
/// expected and the found value.
pub(super) fn error(path: &Path, expected: &str, error: &serde_json::Error) -> Error {
    let text = error.to_string();
    // serde_json appends the place, which `at` holds.
    let got = text.split(" at line ").next().unwrap_or(&text);
    let got = got
        .replace("invalid type: null, expected f64", "a number that is NaN, infinite or missing");
    let place = format!(":{}:{}", error.line(), error.column());
    let at = if error.line() > 0 { place } else { String::new() };
    Error::format(path, expected, got).at(at)
}

/// `bytes` in UTF-8 without a byte order mark. UTF-16 is known by its mark.
pub(super) fn utf8(bytes: &[u8]) -> Cow<'_, [u8]> {
    let [little, big] = MARKS_16.map(|mark| bytes.strip_prefix(mark));
    let Some(rest) = little.or(big) else {
        return Cow::Borrowed(bytes.strip_prefix(MARK).unwrap_or(bytes));
    };
    let unit = |pair: &[u8]| match little {
        Some(_) => u16::from_le_bytes([pair[0], pair[1]]),
        None => u16::from_be_bytes([pair[0], pair[1]]),
    };
    let units: Vec<u16> = rest.chunks_exact(2).map(unit).collect();
    Cow::Owned(String::from_utf16_lossy(&units).into_bytes())
}

/// `bytes` without a byte order mark, and with `null` for numbers that JSON lacks.
fn clean(bytes: &[u8]) -> Cow<'_, [u8]> {
    match utf8(bytes) {
        Cow::Borrowed(bytes) => without_words(bytes),
        Cow::Owned(bytes) => Cow::Owned(without_words(&bytes).into_owned()),
    }
}

/// `bytes` with `null` for numbers that JSON lacks.
fn without_words(bytes: &[u8]) -> Cow<'_, [u8]> {
    let mut out = Vec::new();
    let (mut in_string, mut at, mut copied) = (false, 0, 0);
    while let Some(byte) = bytes.get(at) {
        let rest = &bytes[at..];
        let word = NOT_NUMBERS.iter().find(|word| rest.starts_with(word.as_bytes()));
        at += match (byte, word) {
            (b'\\', _) if in_string => 2,
            (b'"', _) => {
                in_string = !in_string;
                1
            }
            (_, Some(word)) if !in_string => {
                out.extend_from_slice(&bytes[copied..at]);
                out.extend_from_slice(b"null");
                copied = at + word.len();
                word.len()
            }
            _ => 1,
        };
    }
    if copied == 0 {
        return Cow::Borrowed(bytes);
    }
    out.extend_from_slice(&bytes[copied..]);
    Cow::Owned(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_json_lacks_are_null_outside_strings() {
        let text = b"\xEF\xBB\xBF{\"NaN \\\" inf\": [NaN, -Infinity, 1.5, nan], \"b\": Infinity}";
        let expected = b"{\"NaN \\\" inf\": [null, null, 1.5, null], \"b\": null}";
        assert_eq!(&*clean(text), expected);
        assert!(matches!(clean(b"{\"a\": 1}"), Cow::Borrowed(_)));
        let value: Vec<Vec<f64>> = rows(value(b"[[1, NaN]]").unwrap()).unwrap();
        assert!(value[0][0] == 1.0 && value[0][1].is_nan());
        let e = parse::<f64>(Path::new("a.json"), b" \nNaN", "a number").unwrap_err().to_string();
        assert!(e.starts_with("a.json:2:") && e.contains("NaN"), "{e}");
    }

    #[test]
    fn utf_16_is_read_by_its_mark() {
        let text = "\u{feff}[\"K\u{fc}che\", NaN]";
        let little: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
        let big: Vec<u8> = text.encode_utf16().flat_map(u16::to_be_bytes).collect();
        for bytes in [text.as_bytes(), &little, &big] {
            let expected = serde_json::json!(["K\u{fc}che", null]);
            assert_eq!(value(bytes).unwrap(), expected);
            assert!(is_list(bytes));
        }
        // Half a unit at the end is left out; half a pair is one character.
        assert_eq!(&*utf8(b"\xFF\xFE1\0\x00\xD8 "), "1\u{fffd}".as_bytes());
    }
}
