//! Rows of records to vectors and back in registers, where AVX-512 is the machine: 16
//! loads and 64 shuffles instead of a scalar move per number.

use super::WIDTH_MAX;
use std::arch::x86_64::*;

/// 16 rows of 16 to 16 columns.
///
/// # Safety
/// The processor has AVX-512F.
#[inline(always)]
unsafe fn transpose(r: [__m512; 16]) -> [__m512; 16] {
    // SAFETY: register operations of the instruction set that the caller vouches for.
    unsafe {
        let (mut t, mut u, mut out) = (r, r, r);
        for i in 0..8 {
            t[2 * i] = _mm512_unpacklo_ps(r[2 * i], r[2 * i + 1]);
            t[2 * i + 1] = _mm512_unpackhi_ps(r[2 * i], r[2 * i + 1]);
        }
        // u[4i + j] holds, in quarter q, column 4q + j of rows 4i to 4i + 3.
        for i in 0..4 {
            let (a, b) = (_mm512_castps_pd(t[4 * i]), _mm512_castps_pd(t[4 * i + 1]));
            let (c, d) = (_mm512_castps_pd(t[4 * i + 2]), _mm512_castps_pd(t[4 * i + 3]));
            u[4 * i] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c));
            u[4 * i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
            u[4 * i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d));
            u[4 * i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
        }
        for j in 0..4 {
            let even = _mm512_shuffle_f32x4::<0x88>(u[j], u[4 + j]);
            let odd = _mm512_shuffle_f32x4::<0xdd>(u[j], u[4 + j]);
            let even_low = _mm512_shuffle_f32x4::<0x88>(u[8 + j], u[12 + j]);
            let odd_low = _mm512_shuffle_f32x4::<0xdd>(u[8 + j], u[12 + j]);
            out[j] = _mm512_shuffle_f32x4::<0x88>(even, even_low);
            out[4 + j] = _mm512_shuffle_f32x4::<0x88>(odd, odd_low);
            out[8 + j] = _mm512_shuffle_f32x4::<0xdd>(even, even_low);
            out[12 + j] = _mm512_shuffle_f32x4::<0xdd>(odd, odd_low);
        }
        out
    }
}

/// Number i of `count` rows, `stride` apart, for i < `length`; further lanes repeat the
/// last row. `None` where `rows` ends before.
///
/// # Safety
/// The processor has AVX-512F.
#[inline(always)]
pub(super) unsafe fn load(
    rows: &[f32],
    length: usize,
    (stride, count): (usize, usize),
) -> Option<[__m512; 16]> {
    if count == 0 || length > WIDTH_MAX || rows.len() < (count - 1) * stride + length {
        return None;
    }
    let mask = ((1u32 << length) - 1) as __mmask16;
    // SAFETY: every row's masked numbers lie in `rows` by the check above.
    unsafe {
        let mut r = [_mm512_setzero_ps(); 16];
        for (lane, r) in r.iter_mut().enumerate() {
            *r = _mm512_maskz_loadu_ps(mask, rows.as_ptr().add(lane.min(count - 1) * stride));
        }
        Some(transpose(r))
    }
}

/// The inverse of [`load`] for `count` ≤ 16 rows; false where `rows` ends before.
///
/// # Safety
/// The processor has AVX-512F.
#[inline(always)]
pub(super) unsafe fn store(
    columns: [__m512; 16],
    length: usize,
    (stride, count): (usize, usize),
    rows: &mut [f32],
) -> bool {
    let fits = count > 0
        && count <= WIDTH_MAX
        && length <= WIDTH_MAX
        && rows.len() >= (count - 1) * stride + length;
    if !fits {
        return false;
    }
    let mask = ((1u32 << length) - 1) as __mmask16;
    // SAFETY: every row's masked numbers lie in `rows` by the check above.
    unsafe {
        let r = transpose(columns);
        for (lane, r) in r.iter().enumerate().take(count) {
            _mm512_mask_storeu_ps(rows.as_mut_ptr().add(lane * stride), mask, *r);
        }
    }
    true
}
