//! Joins matches of pairs to tracks: the features of several photographs that show one point.

use std::collections::HashMap;

/// A feature of a photograph.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct FeatureId {
    /// Index of the photograph.
    pub photo: usize,
    /// Index of the feature.
    pub feature: usize,
}

/// Returns tracks of at least two photographs, in the order of their first features. A track that
/// holds two features of one photograph contradicts itself and is left out.
pub(super) fn tracks(matches: impl Iterator<Item = [FeatureId; 2]>) -> Vec<Vec<FeatureId>> {
    let mut ids: HashMap<FeatureId, usize> = HashMap::new();
    let mut features: Vec<FeatureId> = Vec::new();
    let mut parents: Vec<usize> = Vec::new();
    for pair in matches {
        let [a, b] = pair.map(|f| {
            *ids.entry(f).or_insert_with(|| {
                features.push(f);
                parents.push(parents.len());
                parents.len() - 1
            })
        });
        let (a, b) = (root(&mut parents, a), root(&mut parents, b));
        parents[a.max(b)] = a.min(b);
    }
    let mut groups: HashMap<usize, Vec<FeatureId>> = HashMap::new();
    for (i, feature) in features.iter().enumerate() {
        groups.entry(root(&mut parents, i)).or_default().push(*feature);
    }
    let mut all: Vec<Vec<FeatureId>> = groups.into_values().collect();
    all.iter_mut().for_each(|t| t.sort());
    all.retain(|t| t.len() > 1 && t.windows(2).all(|w| w[0].photo != w[1].photo));
    all.sort();
    all
}

/// Root of a tree of the forest `parents`, with shorter paths afterwards.
pub(super) fn root(parents: &mut [usize], mut at: usize) -> usize {
    while parents[at] != at {
        parents[at] = parents[parents[at]];
        at = parents[at];
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_are_joined_and_contradictions_left_out() {
        let f = |photo, feature| FeatureId { photo, feature };
        let matches = [
            [f(0, 1), f(1, 5)],
            [f(1, 5), f(2, 2)],
            [f(3, 0), f(2, 9)],
            [f(0, 7), f(1, 8)],
            [f(0, 3), f(1, 8)],
        ];
        let found = tracks(matches.into_iter());
        assert_eq!(found, [vec![f(0, 1), f(1, 5), f(2, 2)], vec![f(2, 9), f(3, 0)]]);
    }
}
