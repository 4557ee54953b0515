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

/// 16 rows of 4, one after the other, to 4 columns: 4 loads and 8 shuffles.
///
/// # Safety
/// The processor has AVX-512F, and `from` points to 64 numbers.
#[inline(always)]
unsafe fn columns_of_4(from: *const f32) -> [__m512; 4] {
    // SAFETY: loads inside the 64 numbers; else register operations.
    unsafe {
        // Numbers 0 and 1 of 8 rows, then 2 and 3: halves of a vector each.
        let first = _mm512_setr_epi32(0, 4, 8, 12, 16, 20, 24, 28, 1, 5, 9, 13, 17, 21, 25, 29);
        let second = _mm512_add_epi32(first, _mm512_set1_epi32(2));
        let v = [0, 16, 32, 48].map(|i| _mm512_loadu_ps(from.add(i)));
        let a = _mm512_permutex2var_ps(v[0], first, v[1]);
        let b = _mm512_permutex2var_ps(v[0], second, v[1]);
        let c = _mm512_permutex2var_ps(v[2], first, v[3]);
        let d = _mm512_permutex2var_ps(v[2], second, v[3]);
        [
            _mm512_shuffle_f32x4::<0x44>(a, c),
            _mm512_shuffle_f32x4::<0xee>(a, c),
            _mm512_shuffle_f32x4::<0x44>(b, d),
            _mm512_shuffle_f32x4::<0xee>(b, d),
        ]
    }
}

/// The inverse of [`columns_of_4`].
///
/// # Safety
/// The processor has AVX-512F, and `to` points to 64 numbers.
#[inline(always)]
unsafe fn rows_of_4(v: [__m512; 4], to: *mut f32) {
    // SAFETY: stores inside the 64 numbers; else register operations.
    unsafe {
        let first = _mm512_setr_epi32(0, 8, 16, 24, 1, 9, 17, 25, 2, 10, 18, 26, 3, 11, 19, 27);
        let second = _mm512_add_epi32(first, _mm512_set1_epi32(4));
        let a = _mm512_shuffle_f32x4::<0x44>(v[0], v[1]);
        let b = _mm512_shuffle_f32x4::<0x44>(v[2], v[3]);
        let c = _mm512_shuffle_f32x4::<0xee>(v[0], v[1]);
        let d = _mm512_shuffle_f32x4::<0xee>(v[2], v[3]);
        _mm512_storeu_ps(to, _mm512_permutex2var_ps(a, first, b));
        _mm512_storeu_ps(to.add(16), _mm512_permutex2var_ps(a, second, b));
        _mm512_storeu_ps(to.add(32), _mm512_permutex2var_ps(c, first, d));
        _mm512_storeu_ps(to.add(48), _mm512_permutex2var_ps(c, second, d));
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
    if (length, stride, count) == (4, 4, 16) {
        // SAFETY: `rows` holds 64 numbers by the check above.
        let [a, b, c, d] = unsafe { columns_of_4(rows.as_ptr()) };
        // SAFETY: all zeros is a vector of 16 `f32`.
        let mut out: [__m512; 16] = unsafe { std::mem::zeroed() };
        (out[0], out[1], out[2], out[3]) = (a, b, c, d);
        return Some(out);
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
    if (length, stride, count) == (4, 4, 16) {
        // SAFETY: `rows` holds 64 numbers by the check above.
        unsafe { rows_of_4([columns[0], columns[1], columns[2], columns[3]], rows.as_mut_ptr()) };
        return true;
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
