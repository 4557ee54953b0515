//! AVX-512: sixteen lanes in one register, truth values in a mask register.
//!
//! SAFETY of every block below: the intrinsics need x86-64-v4. A [`Token`] exists in
//! [`run`] only, whose caller checked the processor, and the vector types are reachable
//! through it only. Loads and stores go through references to whole arrays, or to places
//! that were checked before.
#![expect(clippy::undocumented_unsafe_blocks, reason = "one reason for all, stated above")]

use super::{
    F32Vector, IntVector, Kernel, LANES, Mask, RowLayout, Simd, Vector, all_inside, elementary,
    first_lanes_bits, rows,
};
use std::arch::x86_64::*;
use std::mem::MaybeUninit;
use std::ops::{Add, BitAnd, BitOr, BitXor, Div, Mul, Neg, Not, Sub};

/// Proof that the processor has x86-64-v4.
#[derive(Clone, Copy)]
pub(super) struct Token(());

#[derive(Clone, Copy)]
#[repr(transparent)]
pub(super) struct F(__m512);

#[derive(Clone, Copy)]
#[repr(transparent)]
pub(super) struct M(__mmask16);

#[derive(Clone, Copy)]
#[repr(transparent)]
pub(super) struct I(__m512i);

/// Returns whether the processor has the features that [`run`] needs.
pub(super) fn detected() -> bool {
    super::avx2::detected()
        && is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512cd")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512vl")
}

/// Runs `kernel` compiled for x86-64-v4.
///
/// # Safety
/// [`detected`] returned true.
#[target_feature(
    enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx2,fma,bmi1,bmi2,lzcnt,popcnt"
)]
pub(super) unsafe fn run<K: Kernel>(kernel: K) -> K::Output {
    kernel.run(Token(()))
}

macro_rules! operators {
    ($($vector:ident $op:ident $method:ident $intrinsic:ident;)*) => { $(
        impl $op for $vector {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(unsafe { $intrinsic(self.0, other.0) })
            }
        }
    )* };
}

operators! {
    F Add add _mm512_add_ps;
    F Sub sub _mm512_sub_ps;
    F Mul mul _mm512_mul_ps;
    F Div div _mm512_div_ps;
    I Add add _mm512_add_epi32;
    I Sub sub _mm512_sub_epi32;
    I BitAnd bitand _mm512_and_si512;
    I BitOr bitor _mm512_or_si512;
    I BitXor bitxor _mm512_xor_si512;
    M BitAnd bitand _kand_mask16;
    M BitOr bitor _kor_mask16;
}

impl Neg for F {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        F(unsafe { _mm512_xor_ps(self.0, _mm512_set1_ps(-0.0)) })
    }
}

impl Not for M {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        M(!self.0)
    }
}

impl Vector for F {
    type Element = f32;
    type Mask = M;
    const LANES: usize = LANES;
    const REGISTERS: usize = 32;

    #[inline(always)]
    fn splat(v: f32) -> F {
        F(unsafe { _mm512_set1_ps(v) })
    }
    #[inline(always)]
    fn constant(v: f64) -> F {
        F::splat(v as f32)
    }
    #[inline(always)]
    fn load(v: &[f32; LANES]) -> F {
        F(unsafe { _mm512_loadu_ps(v.as_ptr()) })
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; LANES]) {
        unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn load_rows<const L: usize>(rows: &[f32], layout: RowLayout) -> [F; L] {
        if L == 4 && layout == DENSE_4 && rows.len() >= 4 * LANES {
            let columns = unsafe { columns_of_4(rows.as_ptr()) };
            let mut out = [F::splat(0.0); L];
            for (out, column) in out.iter_mut().zip(columns) {
                *out = F(column);
            }
            return out;
        }
        rows::load_transposed(Token(()), rows, layout)
    }
    #[inline(always)]
    fn store_rows<const L: usize>(from: &[F; L], layout: RowLayout, rows: &mut [f32]) {
        if L == 4 && layout == DENSE_4 && rows.len() >= 4 * LANES {
            let mut columns = [unsafe { _mm512_setzero_ps() }; 4];
            for (column, from) in columns.iter_mut().zip(from) {
                *column = from.0;
            }
            unsafe { rows_of_4(columns, rows.as_mut_ptr()) };
            return;
        }
        assert!(layout.fits(L, rows.len()), "rows: past the end of the slice");
        let lines = rows::transposed(Token(()), from);
        let bits = first_lanes_bits(L);
        for (lane, line) in lines.iter().enumerate().take(layout.count) {
            unsafe {
                let row = rows.as_mut_ptr().add(lane * layout.stride);
                Token(()).store_masked(*line, row.cast(), bits);
            }
        }
    }
    #[inline(always)]
    fn fma(self, b: F, c: F) -> F {
        F(unsafe { _mm512_fmadd_ps(self.0, b.0, c.0) })
    }
    #[inline(always)]
    fn fnma(self, b: F, c: F) -> F {
        F(unsafe { _mm512_fnmadd_ps(self.0, b.0, c.0) })
    }
    #[inline(always)]
    fn max(self, other: F) -> F {
        F(unsafe { _mm512_max_ps(other.0, self.0) })
    }
    #[inline(always)]
    fn min(self, other: F) -> F {
        F(unsafe { _mm512_min_ps(other.0, self.0) })
    }
    #[inline(always)]
    fn sqrt(self) -> F {
        F(unsafe { _mm512_sqrt_ps(self.0) })
    }
    #[inline(always)]
    fn abs(self) -> F {
        F(unsafe { _mm512_abs_ps(self.0) })
    }
    #[inline(always)]
    fn floor(self) -> F {
        const DOWN: i32 = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
        F(unsafe { _mm512_roundscale_ps::<DOWN>(self.0) })
    }
    #[inline(always)]
    fn lt(self, other: F) -> M {
        M(unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0) })
    }
    #[inline(always)]
    fn le(self, other: F) -> M {
        M(unsafe { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(self.0, other.0) })
    }
    elementary::functions!();
}

impl F32Vector for F {
    type Int = I;

    #[inline(always)]
    fn approx_sqrt(self) -> F {
        F(unsafe { _mm512_mul_ps(self.0, _mm512_rsqrt14_ps(self.0)) })
    }
    #[inline(always)]
    fn neg_abs(self) -> F {
        F(unsafe { _mm512_or_ps(self.0, _mm512_set1_ps(-0.0)) })
    }
    #[inline(always)]
    fn ceil(self) -> F {
        const UP: i32 = _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC;
        F(unsafe { _mm512_roundscale_ps::<UP>(self.0) })
    }
    #[inline(always)]
    fn round_and_fraction(self) -> (F, F) {
        const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;
        let n = F(unsafe { _mm512_roundscale_ps::<NEAREST>(self.0) });
        (n, self - n)
    }
    #[inline(always)]
    fn scale_by_power_of_two(self, e: F) -> F {
        F(unsafe { _mm512_scalef_ps(self.0, e.0) })
    }
    #[inline(always)]
    fn to_bits(self) -> I {
        I(unsafe { _mm512_castps_si512(self.0) })
    }
    #[inline(always)]
    fn from_bits(v: I) -> F {
        F(unsafe { _mm512_castsi512_ps(v.0) })
    }
    #[inline(always)]
    fn to_int(self) -> I {
        I(unsafe { _mm512_cvttps_epi32(self.0) })
    }
    #[inline(always)]
    fn from_int(v: I) -> F {
        F(unsafe { _mm512_cvtepi32_ps(v.0) })
    }
}

impl Mask<F> for M {
    #[inline(always)]
    fn select(self, a: F, b: F) -> F {
        F(unsafe { _mm512_mask_blend_ps(self.0, b.0, a.0) })
    }
    #[inline(always)]
    fn select_or_zero(self, v: F) -> F {
        F(unsafe { _mm512_maskz_mov_ps(self.0, v.0) })
    }
    #[inline(always)]
    fn any(self) -> bool {
        self.0 != 0
    }
    #[inline(always)]
    fn to_bits(self) -> u32 {
        u32::from(self.0)
    }
}

impl IntVector for I {
    #[inline(always)]
    fn splat(v: i32) -> I {
        I(unsafe { _mm512_set1_epi32(v) })
    }
    #[inline(always)]
    fn store(self, to: &mut [i32; LANES]) {
        unsafe { _mm512_storeu_si512(to.as_mut_ptr().cast(), self.0) }
    }
    #[inline(always)]
    fn shl<const N: u32>(self) -> I {
        I(unsafe { _mm512_slli_epi32::<N>(self.0) })
    }
    #[inline(always)]
    fn shl_each(self, by: I) -> I {
        I(unsafe { _mm512_sllv_epi32(self.0, by.0) })
    }
    #[inline(always)]
    fn shr<const N: u32>(self) -> I {
        I(unsafe { _mm512_srai_epi32::<N>(self.0) })
    }
}

impl Simd for Token {
    type F = F;
    type M = M;
    type I = I;

    #[inline(always)]
    fn call<K: Kernel>(self, kernel: K) -> K::Output {
        unsafe { run(kernel) }
    }
    #[inline(always)]
    fn store_uninit(self, v: F, to: &mut [MaybeUninit<f32>; LANES]) {
        unsafe { _mm512_storeu_ps(to.as_mut_ptr().cast(), v.0) }
    }
    #[inline(always)]
    fn mask_from_bits(self, bits: u32) -> M {
        M(bits as u16)
    }
    #[inline(always)]
    fn prefetch<T>(self, v: *const T) {
        unsafe { _mm_prefetch::<_MM_HINT_T0>(v.cast()) }
    }
    #[inline(always)]
    fn prefetch_l2<T>(self, v: *const T) {
        unsafe { _mm_prefetch::<_MM_HINT_T1>(v.cast()) }
    }
    #[inline(always)]
    fn sum(self, v: F) -> f32 {
        unsafe {
            let half = _mm256_add_ps(_mm512_castps512_ps256(v.0), _mm512_extractf32x8_ps::<1>(v.0));
            super::avx2::sum8(half)
        }
    }
    #[inline(always)]
    fn sums<const N: usize>(self, v: [F; N]) -> [f32; N] {
        const { assert!(N <= LANES) };
        let mut out = [0.0; LANES];
        unsafe {
            let mut a = [_mm512_setzero_ps(); LANES];
            for (a, v) in a.iter_mut().zip(v) {
                *a = v.0;
            }
            // Each of four steps adds halves of two vectors into one vector.
            for i in 0..8 {
                let (x, y) = (a[2 * i], a[2 * i + 1]);
                let own = _mm512_mask_blend_ps(0xff00, x, y);
                a[i] = _mm512_add_ps(own, _mm512_shuffle_f32x4::<0x4e>(x, y));
            }
            for i in 0..4 {
                let (x, y) = (a[2 * i], a[2 * i + 1]);
                let even = _mm512_shuffle_f32x4::<0x88>(x, y);
                a[i] = _mm512_add_ps(even, _mm512_shuffle_f32x4::<0xdd>(x, y));
            }
            for i in 0..2 {
                let (x, y) = (a[2 * i], a[2 * i + 1]);
                let own = _mm512_mask_blend_ps(0xcccc, x, y);
                a[i] = _mm512_add_ps(own, _mm512_shuffle_ps::<0x4e>(x, y));
            }
            let even = _mm512_shuffle_ps::<0x88>(a[0], a[1]);
            let sums = _mm512_add_ps(even, _mm512_shuffle_ps::<0xdd>(a[0], a[1]));
            // Lane 4i + j holds the sum of vector i + 4j.
            let places = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
            self.store(F(_mm512_permutexvar_ps(places, sums)), &mut out);
        }
        let mut first = [0.0; N];
        first.copy_from_slice(&out[..N]);
        first
    }
    #[inline(always)]
    fn gather4(self, from: &[f32], at: &[usize; LANES], offset: usize) -> [F; 4] {
        if !all_inside(from.len(), at, offset) {
            return [self.splat(0.0); 4];
        }
        unsafe {
            let p = from.as_ptr().add(offset);
            let mut joined = [_mm512_setzero_ps(); 4];
            // Rows i, i + 4, i + 8, i + 12 form a vector, so that the 4×4 transposes inside
            // 128-bit parts leave the rows in order.
            for i in 0..4 {
                let v = _mm512_castps128_ps512(_mm_loadu_ps(p.add(at[i])));
                let v = _mm512_insertf32x4::<1>(v, _mm_loadu_ps(p.add(at[i + 4])));
                let v = _mm512_insertf32x4::<2>(v, _mm_loadu_ps(p.add(at[i + 8])));
                joined[i] = _mm512_insertf32x4::<3>(v, _mm_loadu_ps(p.add(at[i + 12])));
            }
            let [a, b, c, d] = transpose4(joined);
            [F(a), F(b), F(c), F(d)]
        }
    }
    #[inline(always)]
    unsafe fn load_masked(self, from: *const f32, bits: u16) -> F {
        F(unsafe { _mm512_maskz_loadu_ps(bits, from) })
    }
    #[inline(always)]
    unsafe fn store_masked(self, v: F, to: *mut MaybeUninit<f32>, bits: u16) {
        unsafe { _mm512_mask_storeu_ps(to.cast(), bits, v.0) }
    }
    #[inline(always)]
    fn rotate_left(self, v: F) -> F {
        unsafe {
            let next = _mm512_setr_epi32(4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 1, 2, 3, 0);
            F(_mm512_permutexvar_ps(next, v.0))
        }
    }
    #[inline(always)]
    fn rotate_right(self, v: F) -> F {
        unsafe {
            let last = _mm512_setr_epi32(15, 12, 13, 14, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11);
            F(_mm512_permutexvar_ps(last, v.0))
        }
    }
    #[inline(always)]
    fn transpose_quarters(self, v: [F; 4]) -> [F; 4] {
        let [a, b, c, d] = unsafe { transpose4([v[0].0, v[1].0, v[2].0, v[3].0]) };
        [F(a), F(b), F(c), F(d)]
    }
    #[inline(always)]
    fn deinterleave_quarters(self, a: F, b: F) -> [F; 2] {
        unsafe {
            let even = _mm512_shuffle_f32x4::<0x88>(a.0, b.0);
            [F(even), F(_mm512_shuffle_f32x4::<0xdd>(a.0, b.0))]
        }
    }
    #[inline(always)]
    fn interleave_quarters(self, even: F, odd: F) -> [F; 2] {
        unsafe {
            let even = _mm512_castps_pd(even.0);
            let odd = _mm512_castps_pd(odd.0);
            let low = _mm512_setr_epi64(0, 1, 8, 9, 2, 3, 10, 11);
            let high = _mm512_setr_epi64(4, 5, 12, 13, 6, 7, 14, 15);
            let low = _mm512_permutex2var_pd(even, low, odd);
            let high = _mm512_permutex2var_pd(even, high, odd);
            [F(_mm512_castpd_ps(low)), F(_mm512_castpd_ps(high))]
        }
    }
    #[inline(always)]
    fn interleave(self, a: F, b: F) -> [F; 2] {
        unsafe {
            let low = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
            let high =
                _mm512_setr_epi32(8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
            let low = _mm512_permutex2var_ps(a.0, low, b.0);
            [F(low), F(_mm512_permutex2var_ps(a.0, high, b.0))]
        }
    }
    #[inline(always)]
    fn deinterleave(self, a: F, b: F) -> [F; 2] {
        unsafe {
            let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            let odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
            let even = _mm512_permutex2var_ps(a.0, even, b.0);
            [F(even), F(_mm512_permutex2var_ps(a.0, odd, b.0))]
        }
    }
    #[inline(always)]
    fn transpose(self, v: [F; LANES]) -> [F; LANES] {
        unsafe {
            // q[a][c]: part b holds rows 4a..4a + 4 of column 4b + c.
            let mut q = [[_mm512_setzero_ps(); 4]; 4];
            for a in 0..4 {
                q[a] = transpose4([v[4 * a].0, v[4 * a + 1].0, v[4 * a + 2].0, v[4 * a + 3].0]);
            }
            let mut out = [F(_mm512_setzero_ps()); LANES];
            for c in 0..4 {
                let low = _mm512_shuffle_f32x4::<0x88>(q[0][c], q[1][c]);
                let high = _mm512_shuffle_f32x4::<0x88>(q[2][c], q[3][c]);
                out[c] = F(_mm512_shuffle_f32x4::<0x88>(low, high));
                out[8 + c] = F(_mm512_shuffle_f32x4::<0xdd>(low, high));
                let low = _mm512_shuffle_f32x4::<0xdd>(q[0][c], q[1][c]);
                let high = _mm512_shuffle_f32x4::<0xdd>(q[2][c], q[3][c]);
                out[4 + c] = F(_mm512_shuffle_f32x4::<0x88>(low, high));
                out[12 + c] = F(_mm512_shuffle_f32x4::<0xdd>(low, high));
            }
            out
        }
    }
}

/// 4×4 transposes inside each 128-bit part.
#[inline(always)]
unsafe fn transpose4(v: [__m512; 4]) -> [__m512; 4] {
    unsafe {
        let a = _mm512_unpacklo_ps(v[0], v[1]);
        let b = _mm512_unpackhi_ps(v[0], v[1]);
        let c = _mm512_unpacklo_ps(v[2], v[3]);
        let d = _mm512_unpackhi_ps(v[2], v[3]);
        [
            _mm512_shuffle_ps::<0x44>(a, c),
            _mm512_shuffle_ps::<0xee>(a, c),
            _mm512_shuffle_ps::<0x44>(b, d),
            _mm512_shuffle_ps::<0xee>(b, d),
        ]
    }
}

/// Sixteen adjacent rows of 4.
const DENSE_4: RowLayout = RowLayout { stride: 4, count: LANES };

/// Loads 16 adjacent rows of 4 as 4 columns: 4 loads and 8 shuffles.
///
/// # Safety
/// `from` points to 64 floats.
#[inline(always)]
unsafe fn columns_of_4(from: *const f32) -> [__m512; 4] {
    unsafe {
        // Elements 0 and 1 of 8 rows, then 2 and 3: half a vector each.
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
/// `to` points to 64 floats.
#[inline(always)]
unsafe fn rows_of_4(v: [__m512; 4], to: *mut f32) {
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
