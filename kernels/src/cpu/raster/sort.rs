//! Front-to-back order of one tile's splats: a stable radix sort of depth bits.
//!
//! Camera z is positive, so its bits as an integer sort as the number does. A tile's
//! depths span few of the 32 bits, and its list fits the first caches: sorting
//! each list where it is used moves fewer bytes through memory than one sort of all
//! splats, whose footprints would then be fetched out of order to find their tiles.
//! Equal depths keep the order in which the list was written, that of the splats.

/// Bits of a digit; a pass costs a table of 2⁸ counts.
const DIGIT_BITS: u32 = 8;
const DIGITS: usize = 1 << DIGIT_BITS;
/// Lists up to this length are sorted by comparison, quicker than by tables.
const SHORT: usize = 48;

/// An entry of a list: depth bits above, place in the list below.
#[inline(always)]
pub(crate) fn entry(z: u32, place: u32) -> u64 {
    u64::from(z) << 32 | u64::from(place)
}

/// Sorts `entries` (made by [`entry`]) by depth, ties by place, and writes the places
/// in that order to `order`. `entries` and `spare`, both as long, are left in any
/// order.
pub(crate) fn depth_order(entries: &mut [u64], spare: &mut [u64], order: &mut [u32]) {
    if entries.len() <= SHORT {
        entries.sort_unstable();
        for (o, e) in order.iter_mut().zip(entries) {
            *o = *e as u32;
        }
        return;
    }
    let z = |e: u64| (e >> 32) as u32;
    let (mut least, mut most) = (u32::MAX, 0);
    for &e in &*entries {
        (least, most) = (least.min(z(e)), most.max(z(e)));
    }
    let bits = u32::BITS - (most - least).leading_zeros();
    match bits.div_ceil(DIGIT_BITS) {
        0 | 1 => radix::<1>(least, entries, spare, order),
        2 => radix::<2>(least, entries, spare, order),
        3 => radix::<3>(least, entries, spare, order),
        _ => radix::<4>(least, entries, spare, order),
    }
}

/// Sorts by the low `PASSES` digits of depth bits − `least`.
fn radix<const PASSES: usize>(
    least: u32,
    entries: &mut [u64],
    spare: &mut [u64],
    order: &mut [u32],
) {
    let digit = |e: u64, pass: usize| {
        (((e >> 32) as u32 - least) >> (pass as u32 * DIGIT_BITS)) as usize & (DIGITS - 1)
    };
    // Neighbours in a list lie side by side in space and share digits: two tables, so
    // that a count does not depend on the previous one.
    let mut tables = [[[0u32; DIGITS]; PASSES]; 2];
    let pairs = entries.chunks_exact(2);
    for &e in pairs.remainder() {
        for pass in 0..PASSES {
            tables[0][pass][digit(e, pass)] += 1;
        }
    }
    for pair in pairs {
        for pass in 0..PASSES {
            tables[0][pass][digit(pair[0], pass)] += 1;
            tables[1][pass][digit(pair[1], pass)] += 1;
        }
    }
    let [mut slots, other] = tables;
    let (mut from, mut to) = (entries, spare);
    for pass in 0..PASSES {
        let slots = &mut slots[pass];
        let mut next = 0;
        for (slot, more) in slots.iter_mut().zip(&other[pass]) {
            next += std::mem::replace(slot, next) + more;
        }
        if pass + 1 == PASSES {
            for &e in &*from {
                let slot = &mut slots[digit(e, pass)];
                if let Some(to) = order.get_mut(*slot as usize) {
                    *to = e as u32;
                }
                *slot += 1;
            }
            return;
        }
        for &e in &*from {
            let slot = &mut slots[digit(e, pass)];
            if let Some(to) = to.get_mut(*slot as usize) {
                *to = e;
            }
            *slot += 1;
        }
        (from, to) = (to, from);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_is_that_of_a_stable_sort() {
        let mut state = 1u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state >> 8
        };
        // All depths, few distinct ones (ties), one, and a narrow range.
        let kinds: [fn(u32) -> f32; 4] = [
            |r| ((r >> 12) as f32 / 16.0 - 100.0).exp2(),
            |r| (r % 7) as f32 + 0.5,
            |_| 3.0,
            |r| 5.0 + (r % 1000) as f32 * 1e-6,
        ];
        for kind in kinds {
            for n in [0, 1, 2, SHORT, SHORT + 1, 300, 5000] {
                let z: Vec<f32> = (0..n).map(|_| kind(next())).collect();
                let mut expected: Vec<u32> = (0..n as u32).collect();
                expected.sort_by(|&a, &b| z[a as usize].total_cmp(&z[b as usize]));
                let places = z.iter().zip(0..);
                let mut entries: Vec<u64> = places.map(|(z, i)| entry(z.to_bits(), i)).collect();
                let (mut spare, mut order) = (vec![0; n], vec![0; n]);
                depth_order(&mut entries, &mut spare, &mut order);
                assert!(order == expected, "{n} entries");
            }
        }
    }
}
