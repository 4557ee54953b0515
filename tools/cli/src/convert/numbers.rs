//! Conversion of weights from one float type to another.

use half::{bf16, f16};
use safetensors::Dtype;

/// Float types of weight files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Float {
    F64,
    F32,
    F16,
    Bf16,
}

impl Float {
    /// The name on the command line and in the report.
    pub fn name(self) -> &'static str {
        match self {
            Self::F64 => "f64",
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
        }
    }

    /// The type in a safetensors file.
    pub fn dtype(self) -> Dtype {
        match self {
            Self::F64 => Dtype::F64,
            Self::F32 => Dtype::F32,
            Self::F16 => Dtype::F16,
            Self::Bf16 => Dtype::BF16,
        }
    }

    /// Converts a safetensors file's type; `None` for other types than these.
    pub fn from_dtype(dtype: Dtype) -> Option<Self> {
        [Self::F64, Self::F32, Self::F16, Self::Bf16].into_iter().find(|f| f.dtype() == dtype)
    }

    fn size(self) -> usize {
        match self {
            Self::F64 => 8,
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
        }
    }

    /// Decodes one element exactly.
    fn decode(self, b: &[u8]) -> f64 {
        match (self, b) {
            (Self::F64, &[a, b, c, d, e, f, g, h]) => f64::from_le_bytes([a, b, c, d, e, f, g, h]),
            (Self::F32, &[a, b, c, d]) => f32::from_le_bytes([a, b, c, d]).into(),
            (Self::F16, &[a, b]) => f16::from_le_bytes([a, b]).to_f64(),
            (Self::Bf16, &[a, b]) => bf16::from_le_bytes([a, b]).to_f64(),
            _ => f64::NAN,
        }
    }

    /// Appends `v`, rounded to nearest, ties to even. f64 becomes f16 and bf16 through f32, as in
    /// PyTorch. Returns `false` where a finite `v` becomes infinite.
    fn encode(self, v: f64, out: &mut Vec<u8>) -> bool {
        match self {
            Self::F64 => {
                out.extend(v.to_le_bytes());
                true
            }
            Self::F32 => {
                out.extend((v as f32).to_le_bytes());
                (v as f32).is_finite()
            }
            Self::F16 => {
                let short = f16::from_f32(v as f32);
                out.extend(short.to_le_bytes());
                short.is_finite()
            }
            Self::Bf16 => {
                let short = bf16::from_f32(v as f32);
                out.extend(short.to_le_bytes());
                short.is_finite()
            }
        }
    }
}

/// Reason for the rejection of an element.
#[derive(Debug, PartialEq, Eq)]
pub struct Rejected {
    pub expected: String,
    pub got: String,
}

/// Converts little-endian elements of type `from` to type `to`. The same type keeps every bit.
pub fn convert(bytes: Vec<u8>, from: Float, to: Float) -> Result<Vec<u8>, Rejected> {
    let same = from == to;
    let elements = bytes.chunks_exact(from.size());
    let mut out = Vec::with_capacity(if same { 0 } else { elements.len() * to.size() });
    for (i, element) in elements.enumerate() {
        let v = from.decode(element);
        if !v.is_finite() {
            let expected = "finite numbers".to_owned();
            let got = format!("{v} at element {i}");
            return Err(Rejected { expected, got });
        }
        if !same && !to.encode(v, &mut out) {
            let expected = format!("numbers within the range of {}", to.name());
            return Err(Rejected { expected, got: format!("{v:e} at element {i}") });
        }
    }
    Ok(if same { bytes } else { out })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn through(values: &[f64], from: Float, to: Float) -> Result<Vec<f64>, Rejected> {
        let mut bytes = Vec::new();
        for v in values {
            from.encode(*v, &mut bytes);
        }
        Ok(convert(bytes, from, to)?.chunks_exact(to.size()).map(|b| to.decode(b)).collect())
    }

    #[test]
    fn the_same_type_keeps_every_bit() {
        for bits in [0x8000_0000u32, 1, 0x007f_ffff, 0xff7f_ffff, 0x3eaa_aaab] {
            let bytes = bits.to_le_bytes().to_vec();
            assert_eq!(convert(bytes.clone(), Float::F32, Float::F32), Ok(bytes));
        }
    }

    #[test]
    fn rounding_is_to_the_nearest_even() {
        // 1 + 2⁻²⁴ lies between two f32, 1 + 2⁻¹¹ between two f16, 1 + 2⁻⁸ between two bf16.
        let half = |n: i32| 1.0 + 2f64.powi(-n);
        for (n, to) in [(24, Float::F32), (11, Float::F16), (8, Float::Bf16)] {
            let odd = half(n) + 2f64.powi(1 - n);
            let above = half(n) + 2f64.powi(-n - 2);
            let got = through(&[half(n), odd, above, -half(n)], Float::F64, to).unwrap();
            let step = 2f64.powi(1 - n);
            assert_eq!(got, [1.0, 1.0 + 2.0 * step, 1.0 + step, -1.0], "{to:?}");
        }
        // Smallest subnormals survive widening; half of one becomes zero.
        let tiny = 2f64.powi(-24);
        assert_eq!(through(&[tiny, -0.0], Float::F16, Float::F32).unwrap()[0], tiny);
        assert_eq!(through(&[tiny / 2.0], Float::F32, Float::F16).unwrap(), [0.0]);
    }

    #[test]
    fn numbers_out_of_range_are_rejected() {
        let e = through(&[1.0, 65520.0], Float::F32, Float::F16).unwrap_err();
        assert_eq!(
            (&*e.expected, &*e.got),
            ("numbers within the range of f16", "6.552e4 at element 1")
        );
        assert_eq!(through(&[65519.0], Float::F32, Float::F16).unwrap(), [65504.0]);
        assert!(through(&[1e39], Float::F64, Float::F32).unwrap_err().got.contains("1e39"));
        assert!(through(&[3.4e38], Float::F32, Float::Bf16).unwrap_err().expected.contains("bf16"));
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for from in [Float::F64, Float::F32, Float::F16, Float::Bf16] {
                for to in [from, Float::F32] {
                    let e = through(&[0.0, 0.0, bad], from, to).unwrap_err();
                    assert_eq!(
                        (e.expected, e.got),
                        ("finite numbers".into(), format!("{bad} at element 2"))
                    );
                }
            }
        }
    }
}
