//! Vector quantization by k-means, without random numbers: the result depends on neither the number of threads nor a seed.

use rayon::prelude::*;
use std::collections::HashMap;

/// Number of values in a codebook, whose indices are bytes.
const CODEBOOK: usize = 256;
/// Number of iterations over a codebook's values, and over vectors.
const VALUE_ITERATIONS: usize = 20;
const VECTOR_ITERATIONS: usize = 8;
/// Number of vectors that a thread assigns to clusters at a time.
const PART: usize = 1 << 12;
/// Maximum number of vectors from which the first of the two levels of centroids is computed.
const SAMPLE: usize = 1 << 15;

/// Numbers that stand for all values of a property, ascending.
pub struct Codebook {
    pub values: Vec<f32>,
}

impl Codebook {
    /// Computes the values that are close to all of `values` in the sense of least squares.
    pub fn build(values: impl Iterator<Item = f32>) -> Self {
        let mut sorted: Vec<f32> = values.collect();
        sorted.sort_unstable_by(f32::total_cmp);
        let mut distinct = sorted.clone();
        distinct.dedup();
        if distinct.len() <= CODEBOOK {
            distinct.resize(CODEBOOK, distinct.last().copied().unwrap_or(0.));
            return Codebook { values: distinct };
        }
        let mut sums = vec![0.];
        sums.extend(sorted.iter().scan(0., |sum, &value| {
            *sum += f64::from(value);
            Some(*sum)
        }));
        // Begins with one half of the values at equal steps of rank, the other half at equal steps of value.
        let step = |k: usize| (2 * k + 1) as f64 / CODEBOOK as f64;
        let (low, high) = (f64::from(sorted[0]), f64::from(sorted[sorted.len() - 1]));
        let by_rank = (0..CODEBOOK / 2).map(|k| sorted[(step(k) * sorted.len() as f64) as usize]);
        let by_value = (0..CODEBOOK / 2).map(|k| (low + step(k) * (high - low)) as f32);
        let mut book = Codebook { values: by_rank.chain(by_value).collect() };
        for _ in 0..VALUE_ITERATIONS {
            book.values.sort_unstable_by(f32::total_cmp);
            let ends = book.values.windows(2).map(|pair| {
                let middle = (pair[0] + pair[1]) / 2.;
                sorted.partition_point(|&value| value <= middle)
            });
            let ends: Vec<usize> = ends.chain([sorted.len()]).collect();
            let mut begin = 0;
            for (value, end) in book.values.iter_mut().zip(ends) {
                if end > begin {
                    *value = ((sums[end] - sums[begin]) / (end - begin) as f64) as f32;
                }
                begin = begin.max(end);
            }
        }
        book.values.sort_unstable_by(f32::total_cmp);
        book
    }

    /// Returns the index of the nearest value.
    pub fn index(&self, value: f32) -> u8 {
        let above = self.values.partition_point(|&other| other < value).min(CODEBOOK - 1);
        let below = above.saturating_sub(1);
        let nearest = if value - self.values[below] <= self.values[above] - value { below } else { above };
        nearest as u8
    }
}

/// Vectors that stand for all vectors of a set, and the index of each vector's representative.
pub struct Palette {
    /// Centroids, one after the other.
    pub centroids: Vec<f32>,
    pub labels: Vec<u32>,
}

impl Palette {
    /// Divides `vectors` of `dim` numbers into at most `size` clusters, in two levels: √`size` clusters of all vectors, each of which is
    /// divided into a share of the centroids in proportion to its number of vectors. Vectors of which at most `size` differ are kept.
    pub fn build(vectors: &[f32], dim: usize, size: usize) -> Self {
        if let Some(palette) = Self::of_distinct(vectors, dim, size) {
            return palette;
        }
        let count = vectors.len() / dim;
        let coarse = (size as f64).sqrt() as usize;
        let sample: Vec<f32> =
            vectors.chunks_exact(dim).step_by(count.div_ceil(SAMPLE)).flatten().copied().collect();
        let first = means_of_clusters(&sample, dim, coarse);
        let coarse_of: Vec<u32> =
            vectors.par_chunks(PART * dim).flat_map_iter(|part| assign(part, dim, &first)).collect();
        let mut members = vec![vec![]; coarse];
        coarse_of.iter().enumerate().for_each(|(index, &cluster)| members[cluster as usize].push(index));
        members.retain(|members| !members.is_empty());
        let divide = |members: &Vec<usize>| {
            let own: Vec<f32> =
                members.iter().flat_map(|&index| &vectors[index * dim..][..dim]).copied().collect();
            let share = (members.len() * (size - coarse) / count + 1).min(members.len());
            let centroids = means_of_clusters(&own, dim, share);
            let labels = assign(&own, dim, &centroids);
            (centroids, labels)
        };
        let parts: Vec<_> = members.par_iter().map(divide).collect();
        let mut palette = Palette { centroids: vec![], labels: vec![0; count] };
        for (members, (centroids, labels)) in members.iter().zip(parts) {
            let first = (palette.centroids.len() / dim) as u32;
            members.iter().zip(labels).for_each(|(&index, label)| palette.labels[index] = first + label);
            palette.centroids.extend(centroids);
        }
        palette
    }

    /// Returns the palette of all distinct vectors, or `None` if they are more than `size`.
    fn of_distinct(vectors: &[f32], dim: usize, size: usize) -> Option<Self> {
        let mut palette = Palette { centroids: vec![], labels: vec![] };
        let mut indices = HashMap::new();
        for vector in vectors.chunks_exact(dim) {
            let bits: Vec<u32> = vector.iter().map(|value| value.to_bits()).collect();
            let next = indices.len() as u32;
            let index = *indices.entry(bits).or_insert(next);
            palette.labels.push(index);
            if index == next {
                palette.centroids.extend(vector);
            }
            if indices.len() > size {
                return None;
            }
        }
        Some(palette)
    }
}

/// Divides `vectors` into `count` clusters (Lloyd's algorithm) and returns their means. The algorithm begins with vectors at equal distances
/// in the list.
fn means_of_clusters(vectors: &[f32], dim: usize, count: usize) -> Vec<f32> {
    let total = vectors.len() / dim;
    let mut centroids: Vec<f32> =
        (0..count).flat_map(|k| &vectors[k * total / count * dim..][..dim]).copied().collect();
    for _ in 0..VECTOR_ITERATIONS {
        let labels = assign(vectors, dim, &centroids);
        let mut sums = vec![0f64; count * dim];
        let mut sizes = vec![0usize; count];
        for (vector, &label) in vectors.chunks_exact(dim).zip(&labels) {
            sizes[label as usize] += 1;
            let sum = &mut sums[label as usize * dim..][..dim];
            sum.iter_mut().zip(vector).for_each(|(sum, value)| *sum += f64::from(*value));
        }
        for (k, &size) in sizes.iter().enumerate().filter(|(_, size)| **size > 0) {
            for (value, sum) in centroids[k * dim..][..dim].iter_mut().zip(&sums[k * dim..]) {
                *value = (sum / size as f64) as f32;
            }
        }
    }
    centroids
}

/// Returns the index of the centroid next to each vector.
fn assign(vectors: &[f32], dim: usize, centroids: &[f32]) -> Vec<u32> {
    let count = centroids.len() / dim;
    // Number by number, so that the compiler vectorizes over centroids.
    let columns: Vec<f32> = (0..dim).flat_map(|d| centroids.iter().skip(d).step_by(dim)).copied().collect();
    let halves: Vec<f32> =
        centroids.chunks_exact(dim).map(|centroid| centroid.iter().map(|c| c * c / 2.).sum()).collect();
    let mut distances = vec![0.; count];
    let mut nearest = |vector: &[f32]| {
        // |x − c|² / 2 without the term that all centroids have in common.
        distances.copy_from_slice(&halves);
        for (value, column) in vector.iter().zip(columns.chunks_exact(count)) {
            distances.iter_mut().zip(column).for_each(|(distance, c)| *distance -= value * c);
        }
        let (mut nearest, mut least) = (0, f32::INFINITY);
        for (index, &distance) in distances.iter().enumerate() {
            if distance < least {
                (nearest, least) = (index as u32, distance);
            }
        }
        nearest
    };
    vectors.chunks_exact(dim).map(&mut nearest).collect()
}
