//! Every tier against the scalar one: bit for bit where nothing is fused, and the
//! fused tiers bit for bit among themselves.

use super::*;
use std::hint::black_box;

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
    match v[at..].first_chunk() {
        Some(v) => v,
        None => unreachable!("numbers come in whole vectors"),
    }
}

/// All operations on 16 lanes of each input; results as bits.
struct Everything<'a>(&'a [f32], &'a [f32], &'a [f32]);

impl Kernel for Everything<'_> {
    type Output = (Vec<u32>, Vec<u32>);

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Self::Output {
        let (mut exact, mut fused) = (Vec::new(), Vec::new());
        let mut buffer = [0.0; LANES];
        let mut integers = [0; LANES];
        let mut put = |to: &mut Vec<u32>, v: S::F| {
            s.store(v, &mut buffer);
            // Which NaN an operation gives is the processor's affair.
            to.extend(buffer.map(|v| if v.is_nan() { u32::MAX } else { v.to_bits() }));
        };
        for at in (0..self.0.len()).step_by(LANES) {
            let a = s.load(lanes(self.0, at));
            let b = s.load(lanes(self.1, at));
            let c = s.load(lanes(self.2, at));
            for v in [a + b, a - b, a * b, a / b, -a, s.min(a, b), s.max(a, b), s.abs(a)] {
                put(&mut exact, v);
            }
            for v in [
                s.negative(a),
                s.sqrt(s.abs(a)),
                s.floor(a),
                s.ceil(a),
                s.splat(lanes(self.0, at)[3]),
            ] {
                put(&mut exact, v);
            }
            let m = s.lt(a, b);
            put(&mut exact, s.select(m, b, c));
            put(&mut exact, s.keep(s.le(b, a), c));
            exact.extend([s.bits(m), s.bits(!m & s.le(a, c)), s.bits(m | s.le(b, b))]);
            exact.extend([u32::from(s.any(m)), s.bits(s.mask(s.bits(m))), s.bits(s.mask(0xa5f1))]);
            let small = s.min(s.max(a, s.splat(-1e9)), s.splat(1e9));
            let (n, f) = s.split(s.min(s.max(a, s.splat(-4e6)), s.splat(4e6)));
            // Which zero it is may differ.
            put(&mut exact, n + s.splat(0.0));
            put(&mut exact, f + s.splat(0.0));
            let e = s.min(s.max(s.floor(a), s.splat(-120.0)), s.splat(120.0));
            put(&mut exact, s.scale(s.splat(1.25), e));
            let i = s.to_int(small) + s.splat_int(7);
            let by = i & s.splat_int(31);
            for v in [
                s.shift(i, by),
                i,
                s.shl::<3>(i),
                s.shr::<5>(i),
                i & s.to_bits(b),
                i | (i - s.to_int(small)),
            ] {
                s.store_int(v, &mut integers);
                exact.extend(integers.map(|v| v as u32));
            }
            put(&mut exact, s.of_int(i));
            exact.push(s.sum(s.of_int(i)).to_bits());
            // Sums of many at once are those of each.
            let (many, few) = (s.sums([s.floor(small); LANES]), s.sums([a, b, c]));
            exact.extend([many[0], many[7], many[15]].map(f32::to_bits));
            for (sum, v) in few.into_iter().zip([a, b, c]) {
                let same = sum.to_bits() == s.sum(v).to_bits();
                assert!(same || sum.is_nan() && s.sum(v).is_nan());
            }
            let places = std::array::from_fn(|l| (at + 29 * l) % (self.1.len() - 8));
            for v in s.load4(self.1, &places, 5) {
                put(&mut exact, v);
            }
            for (at, offset) in [(self.1.len() - 3, 0), (0, self.1.len() - 3), (9, usize::MAX)] {
                put(&mut exact, s.load4(self.1, &[at; LANES], offset)[0]);
            }
            put(&mut exact, s.load4(&self.1[..3], &[0; LANES], 0)[0]);
            put(&mut exact, s.after(a));
            put(&mut exact, s.before(a));
            for v in s.zip(a, b).into_iter().chain(s.unzip(b, c)) {
                put(&mut exact, v);
            }
            let mut fresh = [MaybeUninit::uninit(); LANES];
            s.store_fresh(b, &mut fresh);
            // SAFETY: just written.
            let fresh = fresh.map(|v| unsafe { v.assume_init() });
            put(&mut exact, s.load(&fresh));
            let past = self.1.len() - at;
            for bits in [u16::MAX, 0x8421, 0, 0xff, 0x7ffe] {
                let inside = if past < LANES { bits & ((1 << past) - 1) } else { bits };
                // SAFETY: no bit of a place beyond the slice's end is set.
                put(&mut exact, unsafe { s.load_lanes(&self.1[at], inside) });
                // SAFETY: as above; what lies before the slice is not read.
                let before = unsafe { s.load_lanes(self.1.as_ptr().wrapping_sub(4), !15) };
                put(&mut exact, before);
                let mut to = *lanes(self.2, at);
                // SAFETY: sixteen places; what is written are numbers.
                unsafe { s.store_lanes(a, to.as_mut_ptr().cast(), bits) };
                put(&mut exact, s.load(&to));
            }
            let rows = [a, b, c, a, b, c, -a, a, b, c, a, b, -c, a, b, c];
            for v in s.transpose(rows) {
                put(&mut exact, v);
            }
            let eight = [a, b, c, -a, -b, -c, a + b, b + c];
            for v in s.columns8(eight).into_iter().chain(s.rows8(eight)) {
                put(&mut exact, v);
            }
            for v in s.transpose4([a, b, c, -a]) {
                put(&mut exact, v);
            }

            for v in [s.fma(a, b, c), s.fnma(a, b, c)] {
                put(&mut fused, v);
            }
            let p = s.min(s.max(a, s.splat(-125.0)), s.splat(126.0));
            put(&mut fused, exp2(s, p));
            put(&mut fused, exp2_by_sums(s, p));
            put(&mut exact, s.keep(s.lt(b, a), exp2_by_sums(s, s.splat(f32::NAN))));
            put(&mut fused, log2(s, s.max(s.abs(a), s.splat(f32::MIN_POSITIVE))));
        }
        (exact, fused)
    }
}

#[test]
fn tiers_agree_to_the_bit() {
    let (a, b, c) = (numbers(1, 4096), numbers(2, 4096), numbers(3, 4096));
    let all = || Everything(&a, &b, &c);
    let (exact, separate) = all().run(array::Separate);
    let (exact_fused, fused) = all().run(array::Fused);
    assert!(exact == exact_fused && separate != fused);
    for &tier in Tier::available() {
        let got = tier.run(all());
        let at = got.0.iter().zip(&exact).position(|(a, b)| a != b);
        assert_eq!(at, None, "{tier:?}");
        let expected = if tier == Tier::Scalar { &separate } else { &fused };
        let at = got.1.iter().zip(expected).position(|(a, b)| a != b);
        assert_eq!(at, None, "{tier:?}, fused");
    }
}

#[test]
fn arrays_do_what_the_standard_library_does() {
    let (a, b, c) = (numbers(4, 256), numbers(5, 256), numbers(6, 256));
    let (exact, _) = Everything(&a, &b, &c).run(array::Separate);
    let bits = |v: f32| if v.is_nan() { u32::MAX } else { v.to_bits() };
    for l in 0..LANES {
        let (a, b) = (a[l], b[l]);
        let expected =
            [a + b, a - b, a * b, a / b, -a, if a < b { a } else { b }, if a > b { a } else { b }];
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
            for power in [exp2(s, v), exp2_by_sums(s, v)] {
                s.store(power, &mut p);
                s.store(log2(s, power), &mut q);
                out.extend(p.into_iter().zip(q));
            }
        }
        out
    }
}

#[test]
fn exponential_and_logarithm() {
    let x: Vec<f32> = (0..1 << 16).map(|i| (i as f32 / 65_536.0 - 0.5) * 250.0).collect();
    for &tier in Tier::available() {
        let (mut worst_exp, mut worst_log) = (0.0f64, 0.0f64);
        let twice = x.as_chunks::<LANES>().0.iter().flat_map(|x| x.iter().chain(x));
        for (x, (exp, log)) in twice.zip(tier.run(Elementary(&x))) {
            worst_exp = worst_exp.max((f64::from(exp) / f64::from(*x).exp2() - 1.0).abs());
            let exact = f64::from(exp).log2();
            worst_log = worst_log.max((f64::from(log) - exact).abs() / exact.abs().max(1.0));
        }
        assert!(worst_exp < 2.4e-7 && worst_log < 1.5e-7, "{tier:?} {worst_exp:e} {worst_log:e}");
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
            s.store(s.rough_sqrt(s.load(v)), &mut out);
            for (v, root) in v.iter().zip(out) {
                worst = worst.max((f64::from(root) / f64::from(*v).sqrt() - 1.0).abs());
            }
        }
        worst
    }
}

#[test]
fn rough_roots_are_as_good_as_they_say() {
    let mut x: Vec<f32> = (0..1 << 16).map(|i| (i as f32 / 300.0 - 100.0).exp2()).collect();
    x.extend([f32::MIN_POSITIVE; LANES]);
    for &tier in Tier::available() {
        let worst = tier.run(Roots(&x));
        assert!(worst < f64::from(ROUGH), "{tier:?} {worst:e}");
    }
}

#[test]
fn tiers_have_names() {
    for &tier in Tier::available() {
        assert_eq!(Tier::named(black_box(tier.name())), Some(tier));
        assert!(tier.is_available());
    }
    assert_eq!(Tier::named("mmx"), None);
    assert!(Tier::best().is_available());
    assert_eq!(Tier::available()[0], Tier::Scalar);
}
