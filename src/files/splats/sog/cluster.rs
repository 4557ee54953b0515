//! Codebooks of numbers and palettes of vectors, by k-means and by a tree of 2-means.
//!
//! Both depend on the numbers alone: sums run in the order of the input, and threads share no sum.
//! A tree costs O(N·dims·log K), where k-means costs O(N·dims·K): 65,536 rows for a million
//! Gaussians take seconds instead of hours. Its squared rounding error is 31 % above that of k-means
//! on random vectors of 9 numbers (100 rows for 3000 vectors).

use rayon::prelude::*;

/// Entries of a codebook: a code is a byte.
const CODES: usize = 256;
/// Steps of k-means of a codebook; it settles in fewer.
const CODEBOOK_STEPS: usize = 50;
/// Bins of equal numbers for the first centroids of a codebook.
const BINS: usize = 4096;
/// Steps of the power iteration for the longest axis of a cluster.
const POWER_STEPS: usize = 4;
/// Steps of 2-means after the cut at the mean.
const SPLIT_STEPS: usize = 2;

/// 256 numbers in ascending order.
pub(super) struct Codebook {
    /// The numbers.
    pub values: Vec<f32>,
    /// Middle between each number and the next.
    borders: Vec<f32>,
}

impl Codebook {
    /// Finds the numbers with a small mean squared distance from `values`, which are finite. Up to
    /// 256 different numbers are kept as they are.
    pub fn of(values: &[f32]) -> Self {
        let mut sorted = values.to_vec();
        sorted.par_sort_unstable_by(f32::total_cmp);
        let mut different = Vec::new();
        for v in &sorted {
            if different.last() != Some(v) {
                different.push(*v);
            }
            if different.len() > CODES {
                return Self::new(k_means(&sorted));
            }
        }
        let last = different.last().copied().unwrap_or(0.0);
        different.resize(CODES, last);
        Self::new(different)
    }

    fn new(values: Vec<f32>) -> Self {
        let borders = values.windows(2).map(|w| 0.5 * (w[0] + w[1])).collect();
        Self { values, borders }
    }

    /// Returns the index of the nearest number.
    pub fn code(&self, v: f32) -> u8 {
        self.borders.partition_point(|border| *border < v) as u8
    }
}

/// Returns 256 centroids of numbers in ascending order.
fn k_means(sorted: &[f32]) -> Vec<f32> {
    let n = sorted.len();
    let mut sums = Vec::with_capacity(n + 1);
    let mut sum = 0.0;
    sums.push(sum);
    for v in sorted {
        sum += f64::from(*v);
        sums.push(sum);
    }
    let mut centroids = first_centroids(sorted);
    for _ in 0..CODEBOOK_STEPS {
        let mut start = 0;
        let mut moved = false;
        for c in 0..CODES {
            let end = match centroids.get(c + 1) {
                None => n,
                Some(next) => {
                    let border = 0.5 * (centroids[c] + next);
                    start + sorted[start..].partition_point(|v| f64::from(*v) <= border)
                }
            };
            if end > start {
                let mean = (sums[end] - sums[start]) / (end - start) as f64;
                moved |= mean != centroids[c];
                centroids[c] = mean;
            }
            start = end;
        }
        // An empty cell keeps its number, which its neighbours may pass.
        centroids.sort_unstable_by(f64::total_cmp);
        if !moved {
            break;
        }
    }
    centroids.into_iter().map(|c| c as f32).collect()
}

/// Returns centroids whose density is the cube root of that of the numbers, the best for small
/// cells (Panter and Dite, 1951): a bin of equal numbers and width w has w^(2/3) of them.
fn first_centroids(sorted: &[f32]) -> Vec<f64> {
    let n = sorted.len();
    let bins = BINS.min(n - 1);
    let edge = |k: usize| f64::from(sorted[k * (n - 1) / bins]);
    let weights: Vec<f64> = (0..bins).map(|k| (edge(k + 1) - edge(k)).powf(2.0 / 3.0)).collect();
    let step = weights.iter().sum::<f64>() / CODES as f64;
    let (mut bin, mut below) = (0, 0.0);
    (0..CODES)
        .map(|c| {
            let wanted = (c as f64 + 0.5) * step;
            while bin + 1 < bins && below + weights[bin] < wanted {
                below += weights[bin];
                bin += 1;
            }
            let part = ((wanted - below) / weights[bin].max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
            edge(bin) + part * (edge(bin + 1) - edge(bin))
        })
        .collect()
}

/// Rows of a palette, and the row of each vector.
pub(super) struct Palette {
    /// `[K, dims]`.
    pub centroids: Vec<f32>,
    /// Row of each vector.
    pub labels: Vec<u16>,
}

/// A leaf of the tree.
struct Cluster {
    members: Vec<u32>,
    mean: Vec<f32>,
    /// Sum of the squared distances from the mean; 0 where the cluster cannot be divided.
    error: f64,
}

/// Vectors, `[N, dims]`.
struct Vectors<'a> {
    all: &'a [f32],
    dims: usize,
}

/// Clusters `vectors`, `[N, dims]`, around at most `size` centroids, 65,536 or fewer. Rows of
/// similar centroids are near one another.
pub(super) fn palette(vectors: &[f32], dims: usize, size: usize) -> Palette {
    let data = Vectors { all: vectors, dims };
    let count = vectors.len() / dims;
    let mut leaves = vec![data.cluster((0..count as u32).collect())];
    loop {
        let mut worst: Vec<usize> = (0..leaves.len()).filter(|&i| leaves[i].error > 0.0).collect();
        // A stable sort: equal errors keep the order of the leaves.
        worst.sort_by(|&a, &b| leaves[b].error.total_cmp(&leaves[a].error));
        // The better half waits, so that the next round compares it with the new leaves.
        worst.truncate(worst.len().div_ceil(2).min(size.saturating_sub(leaves.len())));
        if worst.is_empty() {
            break;
        }
        let mut chosen = vec![false; leaves.len()];
        worst.iter().for_each(|&i| chosen[i] = true);
        leaves = leaves
            .into_par_iter()
            .zip(chosen)
            .flat_map_iter(|(leaf, chosen)| if chosen { data.split(leaf) } else { vec![leaf] })
            .collect();
    }
    let mut labels = vec![0; count];
    for (k, leaf) in leaves.iter().enumerate() {
        leaf.members.iter().for_each(|&i| labels[i as usize] = k as u16);
    }
    let centroids = leaves.iter().flat_map(|leaf| leaf.mean.iter().copied()).collect();
    Palette { centroids, labels }
}

impl Vectors<'_> {
    fn row(&self, i: u32) -> &[f32] {
        &self.all[i as usize * self.dims..][..self.dims]
    }

    fn cluster(&self, members: Vec<u32>) -> Cluster {
        let mean = self.mean(&members);
        let error = members
            .iter()
            .map(|&i| {
                self.row(i).iter().zip(&mean).map(|(v, m)| f64::from(v - m).powi(2)).sum::<f64>()
            })
            .sum();
        Cluster { members, mean, error }
    }

    fn mean(&self, members: &[u32]) -> Vec<f32> {
        let mut sums = vec![0.0f64; self.dims];
        for &i in members {
            sums.iter_mut().zip(self.row(i)).for_each(|(s, v)| *s += f64::from(*v));
        }
        let n = members.len().max(1) as f64;
        sums.into_iter().map(|s| (s / n) as f32).collect()
    }

    /// Divides a cluster across its longest axis. A cluster that does not divide comes back with an
    /// error of 0.
    fn split(&self, cluster: Cluster) -> Vec<Cluster> {
        let axis = self.longest_axis(&cluster);
        let offset = dot(&axis, &cluster.mean);
        let mut cut = self.cut(&cluster.members, &axis, offset);
        for _ in 0..SPLIT_STEPS {
            if cut.iter().any(Vec::is_empty) {
                break;
            }
            let [a, b] = [self.mean(&cut[0]), self.mean(&cut[1])];
            let axis: Vec<f32> = b.iter().zip(&a).map(|(b, a)| b - a).collect();
            let middle: Vec<f32> = b.iter().zip(&a).map(|(b, a)| 0.5 * (a + b)).collect();
            let next = self.cut(&cluster.members, &axis, dot(&axis, &middle));
            if next.iter().any(Vec::is_empty) {
                break;
            }
            cut = next;
        }
        if cut.iter().any(Vec::is_empty) {
            return vec![Cluster { error: 0.0, ..cluster }];
        }
        cut.map(|members| self.cluster(members)).into()
    }

    /// Divides `members` at `offset` along `axis`.
    fn cut(&self, members: &[u32], axis: &[f32], offset: f32) -> [Vec<u32>; 2] {
        let (low, high) = members.iter().copied().partition(|&i| dot(axis, self.row(i)) <= offset);
        [low, high]
    }

    /// Estimates the axis of the largest variance.
    fn longest_axis(&self, cluster: &Cluster) -> Vec<f32> {
        let centred = |i: u32, to: &mut [f32]| {
            for ((t, v), m) in to.iter_mut().zip(self.row(i)).zip(&cluster.mean) {
                *t = v - m;
            }
        };
        let mut vector = vec![0.0f32; self.dims];
        // The member farthest from the mean is near the longest axis.
        let mut axis = vec![0.0f32; self.dims];
        let mut farthest = 0.0;
        for &i in &cluster.members {
            centred(i, &mut vector);
            let length = dot(&vector, &vector);
            if length > farthest {
                farthest = length;
                axis.copy_from_slice(&vector);
            }
        }
        for _ in 0..POWER_STEPS {
            let mut sums = vec![0.0f64; self.dims];
            for &i in &cluster.members {
                centred(i, &mut vector);
                let along = dot(&vector, &axis);
                sums.iter_mut().zip(&vector).for_each(|(s, v)| *s += f64::from(along * v));
            }
            let length = sums.iter().map(|s| s * s).sum::<f64>().sqrt();
            if !(length > 0.0 && length.is_finite()) {
                break;
            }
            axis.iter_mut().zip(&sums).for_each(|(a, s)| *a = (s / length) as f32);
        }
        axis
    }
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use subsplat_kernels::layout::random;

    fn numbers(n: usize) -> Vec<f32> {
        let mut state = 7;
        let unit = |state: &mut u64| (random::next(state) >> 11) as f64 / (1u64 << 53) as f64;
        // Many small numbers and a few large ones.
        (0..n).map(|_| (unit(&mut state) * 2.0 - 1.0).powi(5) as f32 * 8.0).collect()
    }

    #[test]
    fn few_numbers_are_kept_and_many_are_near_their_codes() {
        let few: Vec<f32> = (0..300).map(|i| (i % 40) as f32 * 0.3 - 4.0).collect();
        let book = Codebook::of(&few);
        assert!(few.iter().all(|v| book.values[usize::from(book.code(*v))] == *v));
        assert_eq!(Codebook::of(&[]).values.len(), CODES);

        let many = numbers(20_000);
        let book = Codebook::of(&many);
        assert!(book.values.is_sorted() && book.values.len() == CODES);
        let error = |value: &dyn Fn(f32) -> f32| {
            many.iter().map(|v| f64::from(value(*v) - v).powi(2)).sum::<f64>() / many.len() as f64
        };
        let found = error(&|v| book.values[usize::from(book.code(v))]);
        let nearest = error(&|v| {
            let distance = |c: &&f32| (**c - v).abs();
            *book.values.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap()
        });
        let uniform = error(&|v| ((v + 8.0) / 16.0 * 255.0).round() / 255.0 * 16.0 - 8.0);
        assert!((found - nearest).abs() < 1e-12, "codes are not the nearest: {found} {nearest}");
        // The least error of 256 codes for these numbers (Panter and Dite): (∫ p(v)^(1/3) dv)³ / (12·256²).
        let least = 129.9 / (12.0 * 65_536.0);
        assert!(found < 1.1 * least && least < 0.5 * uniform, "{found}, {least}, {uniform}");
    }

    /// Sum of the squared distances from the labelled rows.
    fn distance(vectors: &[f32], dims: usize, palette: &Palette) -> f64 {
        let rows = vectors.chunks_exact(dims).zip(&palette.labels);
        rows.map(|(v, l)| {
            let row = &palette.centroids[usize::from(*l) * dims..][..dims];
            v.iter().zip(row).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>()
        })
        .sum()
    }

    #[test]
    fn a_palette_holds_few_vectors_exactly_and_is_near_k_means() {
        let dims = 9;
        let few: Vec<f32> = numbers(50 * dims).repeat(20);
        let exact = palette(&few, dims, 64);
        assert_eq!((exact.centroids.len() / dims, exact.labels.len()), (50, 1000));
        assert!(distance(&few, dims, &exact) < 1e-6);
        // All the same: one row, and no endless division.
        assert_eq!(palette(&[0.5; 90], dims, 64).centroids, [0.5; 9]);

        let many = numbers(3000 * dims);
        let found = palette(&many, dims, 100);
        assert_eq!(found.centroids.len(), 100 * dims);
        let tree = distance(&many, dims, &found);
        // k-means from the tree's rows cannot be far below.
        let mut best = found;
        for _ in 0..10 {
            let nearest = |v: &[f32]| {
                let far =
                    |row: &[f32]| v.iter().zip(row).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
                let rows = best.centroids.chunks_exact(dims).map(far).enumerate();
                rows.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap().0 as u16
            };
            best.labels = many.chunks_exact(dims).map(nearest).collect();
            let data = Vectors { all: &many, dims };
            for k in 0..100 {
                let members: Vec<u32> =
                    (0..3000).filter(|&i| best.labels[i as usize] == k as u16).collect();
                if !members.is_empty() {
                    best.centroids[k * dims..][..dims].copy_from_slice(&data.mean(&members));
                }
            }
        }
        let k_means = distance(&many, dims, &best);
        assert!(tree < 1.4 * k_means, "{tree} against {k_means} of k-means");
    }

    #[test]
    fn threads_change_no_row_of_a_palette() {
        let vectors = numbers(5000 * 24);
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let found = pool.install(|| palette(&vectors, 24, 300));
            (found.centroids, found.labels)
        };
        assert!(with(1) == with(3));
    }
}
