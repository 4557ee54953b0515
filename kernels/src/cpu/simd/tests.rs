//! Every level against arrays of floats, with separate and with fused products, bit for bit.
//! Elementary functions against the standard library in f64.

use super::array::Array;
use super::elementary::{erf, exp, exp_m1, exp2, exp2_by_sums, ln, ln_1p, log2, sin_cos, tanh};
use super::real::OnLevel;
use super::*;
use std::hint::black_box;
use std::mem::MaybeUninit;

/// Numbers of many sizes and both signs, and the special ones.
fn numbers(seed: u32, n: usize) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state >> 8
    };
    let special = [0.0, -0.0, 1.0, -1.0, 0.5, 1e30, -1e30, 8_388_607.5, f32::NAN, f32::INFINITY];
    let mut out: Vec<f32> = special.to_vec();
    while out.len() < n {
        let unit = next() as f32 / (1 << 24) as f32 - 0.5;
        out.push(unit * ((next() % 40) as f32 - 20.0).exp2());
    }
    out.truncate(n);
    out
}

fn lanes(v: &[f32], at: usize) -> &[f32; LANES] {
    v[at..].first_chunk().expect("numbers come in whole vectors")
}

/// All operations on 16 lanes of each input; results as bits.
struct Everything<'a>(&'a [f32], &'a [f32], &'a [f32]);

impl Kernel for Everything<'_> {
    type Output = (Vec<u32>, Vec<u32>);

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Self::Output {
        let mut exact = Vec::new();
        let mut fused = Vec::new();
        let mut buffer = [0.0; LANES];
        let mut integers = [0; LANES];
        let mut put = |to: &mut Vec<u32>, v: S::F| {
            s.store(v, &mut buffer);
            // Processors differ in the NaN that an operation gives.
            to.extend(buffer.map(|v| if v.is_nan() { u32::MAX } else { v.to_bits() }));
        };
        for at in (0..self.0.len()).step_by(LANES) {
            let a = s.load(lanes(self.0, at));
            let b = s.load(lanes(self.1, at));
            let c = s.load(lanes(self.2, at));
            for v in [a + b, a - b, a * b, a / b, -a, a.min(b), a.max(b), a.abs()] {
                put(&mut exact, v);
            }
            for v in
                [a.neg_abs(), a.abs().sqrt(), a.floor(), a.ceil(), s.splat(lanes(self.0, at)[3])]
            {
                put(&mut exact, v);
            }
            let m = a.lt(b);
            put(&mut exact, m.select(b, c));
            put(&mut exact, b.le(a).select_or_zero(c));
            exact.extend([m.to_bits(), (!m & a.le(c)).to_bits(), (m | b.le(b)).to_bits()]);
            exact.extend([
                u32::from(m.any()),
                s.mask_from_bits(m.to_bits()).to_bits(),
                s.mask_from_bits(0xa5f1).to_bits(),
            ]);
            let small = s.splat(-1e9).max(a).min(s.splat(1e9));
            let (n, f) = s.splat(-4e6).max(a).min(s.splat(4e6)).round_and_fraction();
            // The sign of zeros may differ.
            put(&mut exact, n + s.splat(0.0));
            put(&mut exact, f + s.splat(0.0));
            let e = s.splat(-120.0).max(a.floor()).min(s.splat(120.0));
            put(&mut exact, s.splat(1.25).scale_by_power_of_two(e));
            let i = small.to_int() + S::I::splat(7);
            let by = i & S::I::splat(31);
            for v in [
                i.shl_each(by),
                i,
                i.shl::<3>(),
                i.shr::<5>(),
                i & b.to_bits(),
                i | (i - small.to_int()),
                i ^ b.to_bits(),
            ] {
                v.store(&mut integers);
                exact.extend(integers.map(|v| v as u32));
            }
            put(&mut exact, S::F::from_int(i));
            exact.push(s.sum(S::F::from_int(i)).to_bits());
            // Sums of many vectors equal the sum of each.
            let many = s.sums([small.floor(); LANES]);
            let few = s.sums([a, b, c]);
            exact.extend([many[0], many[7], many[15]].map(f32::to_bits));
            for (sum, v) in few.into_iter().zip([a, b, c]) {
                let same = sum.to_bits() == s.sum(v).to_bits();
                assert!(same || sum.is_nan() && s.sum(v).is_nan());
            }
            let places = std::array::from_fn(|l| (at + 29 * l) % (self.1.len() - 8));
            for v in s.gather4(self.1, &places, 5) {
                put(&mut exact, v);
            }
            for (at, offset) in [(self.1.len() - 3, 0), (0, self.1.len() - 3), (9, usize::MAX)] {
                put(&mut exact, s.gather4(self.1, &[at; LANES], offset)[0]);
            }
            put(&mut exact, s.gather4(&self.1[..3], &[0; LANES], 0)[0]);
            put(&mut exact, s.rotate_left(a));
            put(&mut exact, s.rotate_right(a));
            for v in s.interleave(a, b).into_iter().chain(s.deinterleave(b, c)) {
                put(&mut exact, v);
            }
            let mut fresh = [MaybeUninit::uninit(); LANES];
            s.store_uninit(b, &mut fresh);
            // SAFETY: `store_uninit` wrote it.
            let fresh = fresh.map(|v| unsafe { v.assume_init() });
            put(&mut exact, s.load(&fresh));
            let past = self.1.len() - at;
            for bits in [u16::MAX, 0x8421, 0, 0xff, 0x7ffe] {
                let inside = if past < LANES { bits & ((1 << past) - 1) } else { bits };
                // SAFETY: no bit of a place beyond the slice's end is set.
                put(&mut exact, unsafe { s.load_masked(&self.1[at], inside) });
                // SAFETY: as above; no bit of a place before the slice is set.
                let before = unsafe { s.load_masked(self.1.as_ptr().wrapping_sub(4), !15) };
                put(&mut exact, before);
                let mut to = *lanes(self.2, at);
                // SAFETY: sixteen places, which stay initialised.
                unsafe { s.store_masked(a, to.as_mut_ptr().cast(), bits) };
                put(&mut exact, s.load(&to));
            }
            let rows = [a, b, c, a, b, c, -a, a, b, c, a, b, -c, a, b, c];
            for v in s.transpose(rows) {
                put(&mut exact, v);
            }
            let eight = [a, b, c, -a, -b, -c, a + b, b + c];
            for v in s.columns_of_8(eight).into_iter().chain(s.rows_of_8(eight)) {
                put(&mut exact, v);
            }
            for v in s.transpose_quarters([a, b, c, -a]) {
                put(&mut exact, v);
            }

            for v in [a.fma(b, c), a.fnma(b, c)] {
                put(&mut fused, v);
            }
            let p = s.splat(-125.0).max(a).min(s.splat(126.0));
            put(&mut fused, exp2(p));
            put(&mut fused, exp2_by_sums(p));
            put(&mut exact, b.lt(a).select_or_zero(exp2_by_sums(s.splat(f32::NAN))));
            let positive = s.splat(f32::MIN_POSITIVE).max(a.abs());
            put(&mut fused, log2(positive));
            put(&mut fused, ln(positive));
            let (sin, cos) = sin_cos(a);
            for v in [exp(a), exp_m1(a), tanh(a), ln_1p(positive), erf(a), sin, cos] {
                put(&mut fused, v);
            }
        }
        (exact, fused)
    }
}

#[test]
fn levels_agree_to_the_bit() {
    let (a, b, c) = (numbers(1, 4096), numbers(2, 4096), numbers(3, 4096));
    let all = || Everything(&a, &b, &c);
    let (exact, separate) = all().run(Array::<false>);
    let (exact_fused, fused) = all().run(Array::<true>);
    assert!(exact == exact_fused && separate != fused);
    for &level in SimdLevel::available() {
        let got = level.run(all());
        let at = got.0.iter().zip(&exact).position(|(a, b)| a != b);
        assert_eq!(at, None, "{level:?}");
        let expected = if level == SimdLevel::Baseline { &separate } else { &fused };
        let at = got.1.iter().zip(expected).position(|(a, b)| a != b);
        assert_eq!(at, None, "{level:?}, fused");
    }
}

#[test]
fn arrays_do_what_the_standard_library_does() {
    let (a, b, c) = (numbers(4, 256), numbers(5, 256), numbers(6, 256));
    let (exact, _) = Everything(&a, &b, &c).run(Array::<false>);
    let bits = |v: f32| if v.is_nan() { u32::MAX } else { v.to_bits() };
    for l in 0..LANES {
        let (a, b) = (a[l], b[l]);
        let expected =
            [a + b, a - b, a * b, a / b, -a, if b < a { b } else { a }, if b > a { b } else { a }];
        for (i, v) in expected.into_iter().enumerate() {
            assert_eq!(exact[i * LANES + l], bits(v), "operation {i}, {a} {b}");
        }
        assert_eq!(exact[8 * LANES + l], bits(-a.abs()), "negative {a}");
        assert_eq!(exact[10 * LANES + l], bits(a.floor()), "floor {a}");
        assert_eq!(exact[11 * LANES + l], bits(a.ceil()), "ceil {a}");
    }
}

struct Elementary<'a>(&'a [f32]);

impl Kernel for Elementary<'_> {
    type Output = Vec<(f32, f32)>;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Self::Output {
        let (mut p, mut q) = ([0.0; LANES], [0.0; LANES]);
        let mut out = Vec::new();
        for v in self.0.as_chunks().0 {
            let v = s.load(v);
            for power in [exp2(v), exp2_by_sums(v)] {
                s.store(power, &mut p);
                s.store(log2(power), &mut q);
                out.extend(p.into_iter().zip(q));
            }
        }
        out
    }
}

#[test]
fn exponential_and_logarithm() {
    let x: Vec<f32> = (0..1 << 16).map(|i| (i as f32 / 65_536.0 - 0.5) * 250.0).collect();
    for &level in SimdLevel::available() {
        let (mut worst_exp, mut worst_log) = (0.0f64, 0.0f64);
        let twice = x.as_chunks::<LANES>().0.iter().flat_map(|x| x.iter().chain(x));
        for (x, (exp, log)) in twice.zip(level.run(Elementary(&x))) {
            worst_exp = worst_exp.max((f64::from(exp) / f64::from(*x).exp2() - 1.0).abs());
            let exact = f64::from(exp).log2();
            worst_log = worst_log.max((f64::from(log) - exact).abs() / exact.abs().max(1.0));
        }
        assert!(worst_exp < 2.4e-7 && worst_log < 1.5e-7, "{level:?} {worst_exp:e} {worst_log:e}");
    }
}

/// Elementary functions of each number, alone in all lanes.
struct Functions<'a>(&'a [f32]);

const NAMES: [&str; 9] = ["exp", "expm1", "tanh", "sin", "cos", "ln", "log2", "ln1p", "erf"];

/// Opacities with their sign turned, −1 < x ≤ 0: the arguments of ln(1 + x).
fn opacity(x: f32) -> f32 {
    -(x.abs() / (x.abs() + 0.001)).min(0.9999)
}

fn functions_of<V: F32Vector>(v: V) -> [V; 9] {
    let (sin, cos) = sin_cos(v);
    let share = v.abs() / (v.abs() + V::splat(0.001));
    let opacity = -share.min(V::splat(0.9999));
    let log = (ln(v.abs()), log2(v.abs()));
    [exp(v), exp_m1(v), tanh(v), sin, cos, log.0, log.1, ln_1p(opacity), erf(v)]
}

impl Kernel for Functions<'_> {
    type Output = Vec<[f32; 9]>;

    fn run<S: Simd>(self, s: S) -> Self::Output {
        let of = |x: &f32| {
            functions_of(s.splat(*x)).map(|v| {
                let mut lanes = [0.0f32; LANES];
                s.store(v, &mut lanes);
                assert!(lanes.iter().all(|l| l.to_bits() == lanes[0].to_bits()));
                lanes[0]
            })
        };
        self.0.iter().map(of).collect()
    }
}

/// erf by its Taylor series, good to 1e-12 for |x| ≤ 4.
fn erf_series(x: f64) -> f64 {
    if x.abs() > 4.0 {
        return x.signum();
    }
    let (mut term, mut sum) = (x, x);
    for n in 1..200 {
        term *= -x * x / n as f64;
        sum += term / (2 * n + 1) as f64;
    }
    sum * 2.0 / std::f64::consts::PI.sqrt()
}

#[test]
fn elementary_functions_are_good_to_a_few_ulp() {
    let want: [fn(f64) -> f64; 9] = [
        f64::exp,
        f64::exp_m1,
        f64::tanh,
        f64::sin,
        f64::cos,
        |x| x.abs().ln(),
        |x| x.abs().log2(),
        f64::ln_1p,
        erf_series,
    ];
    // Relative error; e^x has the tighter bound that plain loops rely on.
    let most = [2.4e-7, 5e-7, 5e-7, 5e-7, 5e-7, 5e-7, 5e-7, 5e-7, 4.8e-7];
    let near = (-8730..=8800).filter(|&i| i != 0).map(|i| i as f32 * 0.01);
    let small = (0..400).map(|i| (i as f32 * -0.07).exp() * if i % 2 == 0 { 1. } else { -1. });
    let far = [1e4f32, -3e5, 1e9, -8191.7].into_iter();
    let x: Vec<f32> = near.chain(small).chain(far).collect();
    let single = x.iter().map(|x| functions_of(*x)).collect::<Vec<_>>();
    let levels = SimdLevel::available().iter().map(|level| level.run(Functions(&x)));
    for (level, got) in std::iter::once(single.clone()).chain(levels).enumerate() {
        // Single numbers round products, as the baseline does.
        assert!(level != 1 || got == single);
        for (x, got) in x.iter().zip(got) {
            for (i, name) in NAMES.iter().enumerate() {
                if (x.abs() > 88.0 || *x < -87.3) && i < 2 {
                    continue;
                }
                // ln(1 + x) down to the largest optical depth that occurs, x = -0.9999.
                let at = f64::from(if i == 7 { opacity(*x) } else { *x });
                let want = want[i](at);
                // Near a zero of sine, cosine or logarithm the error is absolute.
                let floor = if (3..7).contains(&i) { 0.3 } else { 1e-30 };
                let error = (f64::from(got[i]) - want).abs() / want.abs().max(floor);
                assert!(error < most[i], "{level}: {name}({at}): {} for {want}, {error:e}", got[i]);
            }
        }
    }
}

#[test]
fn elementary_functions_at_special_numbers() {
    let x = [f32::NAN, 0.0, -40.0, 40.0, -100.0, f32::INFINITY, 9.0];
    let single = x.iter().map(|x| functions_of(*x)).collect::<Vec<_>>();
    let levels = SimdLevel::available().iter().map(|level| level.run(Functions(&x)));
    for got in std::iter::once(single).chain(levels) {
        assert!(got[0].iter().all(|v| v.is_nan()), "{:?}", got[0]);
        assert_eq!(got[1][..5], [1.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!((got[2][2], got[3][2]), (-1.0, 1.0));
        // No denormal: 0 below e^-87.3.
        assert_eq!(got[4][..2], [0.0, -1.0]);
        assert!(got[5][0].is_finite() && got[5][5] == f32::INFINITY && got[5][6] == f32::INFINITY);
        assert!((got[6][8] - 1.0).abs() < 2.4e-7);
    }
}

/// Rows of several lengths, strides and counts through vectors and back.
struct Rows<'a>(&'a [f32]);

impl VectorKernel<f32> for Rows<'_> {
    type Output = Vec<u32>;

    fn run<V: Vector<Element = f32>>(self) -> Vec<u32> {
        let mut out = Vec::new();
        rows_of_length::<V, 1>(self.0, &mut out);
        rows_of_length::<V, 3>(self.0, &mut out);
        rows_of_length::<V, 4>(self.0, &mut out);
        rows_of_length::<V, 11>(self.0, &mut out);
        rows_of_length::<V, 16>(self.0, &mut out);
        out
    }
}

fn rows_of_length<V: Vector<Element = f32>, const L: usize>(from: &[f32], out: &mut Vec<u32>) {
    for (stride, count) in [(L, LANES), (L, 5), (L + 3, LANES), (2 * L, 1), (40, 13)] {
        // Records up to the slice's very end.
        let rows = &from[..(count - 1) * stride + L];
        let layout = RowLayout { stride, count };
        let vectors: [V; L] = V::load_rows(rows, layout);
        let mut lanes = [0.0; LANES];
        for (i, v) in vectors.iter().enumerate() {
            v.store(&mut lanes);
            for (lane, v) in lanes.iter().enumerate() {
                assert_eq!(v.to_bits(), rows[lane.min(count - 1) * stride + i].to_bits());
            }
        }
        let mut back = vec![-7.0; rows.len()];
        V::store_rows(&vectors, layout, &mut back);
        out.extend(back.iter().map(|v| v.to_bits()));
        for (i, (v, row)) in back.iter().zip(rows).enumerate() {
            let inside = i % stride < L;
            assert_eq!(v.to_bits(), if inside { row.to_bits() } else { (-7.0f32).to_bits() });
        }
    }
}

#[test]
fn rows_go_to_vectors_and_back() {
    let from: Vec<f32> = (0..700).map(|i| i as f32 + 0.5).collect();
    for &level in SimdLevel::available() {
        level.run(OnLevel(Rows(&from)));
    }
}

struct Roots<'a>(&'a [f32]);

impl Kernel for Roots<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> f64 {
        let mut out = [0.0; LANES];
        let mut worst = 0.0f64;
        for v in self.0.as_chunks().0 {
            s.store(s.load(v).approx_sqrt(), &mut out);
            for (v, root) in v.iter().zip(out) {
                worst = worst.max((f64::from(root) / f64::from(*v).sqrt() - 1.0).abs());
            }
        }
        worst
    }
}

#[test]
fn approximate_roots_keep_their_bound() {
    let mut x: Vec<f32> = (0..1 << 16).map(|i| (i as f32 / 300.0 - 100.0).exp2()).collect();
    x.extend([f32::MIN_POSITIVE; LANES]);
    for &level in SimdLevel::available() {
        let worst = level.run(Roots(&x));
        assert!(worst < f64::from(APPROX_SQRT_ERROR), "{level:?} {worst:e}");
    }
}

#[test]
fn levels_have_names() {
    for &level in SimdLevel::available() {
        assert_eq!(SimdLevel::named(black_box(level.name())), Some(level));
        assert!(level.is_available());
    }
    assert_eq!(SimdLevel::named("mmx"), None);
    assert!(SimdLevel::best().is_available());
    assert_eq!(SimdLevel::available()[0], SimdLevel::Baseline);
}
