//! Groups of photographs: verified pairs join each photograph of a group to the others.
//! Photographs of several scenes, or of two sides of one, fall into groups that share no points.

use super::estimate::LeftOut;
use super::tracks::root;

/// Photographs of a group that has pairs with the photographs that are used: at least this many are
/// called a group. Fewer are called photographs that do not fit.
const MIN_JOINED_GROUP: usize = 3;

/// A division of photographs into groups.
pub(super) struct Groups {
    /// Group of each photograph: the index of its first photograph.
    of: Vec<usize>,
    /// Number of photographs of each group, at the index of its first photograph.
    sizes: Vec<usize>,
}

impl Groups {
    /// The groups of `count` photographs by `pairs` of their indices. A photograph without a pair is
    /// a group of its own.
    pub(super) fn new(count: usize, pairs: impl Iterator<Item = [usize; 2]>) -> Self {
        let mut parents: Vec<usize> = (0..count).collect();
        for pair in pairs {
            let [a, b] = pair.map(|photo| root(&mut parents, photo));
            parents[a.max(b)] = a.min(b);
        }
        let of: Vec<usize> = (0..count).map(|photo| root(&mut parents, photo)).collect();
        let mut sizes = vec![0; count];
        of.iter().for_each(|&group| sizes[group] += 1);
        Self { of, sizes }
    }

    /// Number of photographs of the group of `photo`.
    pub(super) fn size(&self, photo: usize) -> usize {
        self.sizes[self.of[photo]]
    }
}

/// The photographs without a camera, with the reason. `placed` has an entry for each photograph;
/// `pairs` are the verified ones.
pub(super) fn left_out(placed: &[bool], pairs: &[[usize; 2]]) -> Vec<LeftOut> {
    let used = placed.iter().filter(|&&p| p).count();
    let inside = |pair: &&[usize; 2]| pair.iter().all(|&photo| !placed[photo]);
    let groups = Groups::new(placed.len(), pairs.iter().filter(inside).copied());
    // Pairs of each group, and pairs of its photographs with those that are used.
    let (mut inner, mut outer) = (vec![0usize; placed.len()], vec![0usize; placed.len()]);
    let mut partners = vec![0usize; placed.len()];
    for pair in pairs {
        let within = inside(&pair);
        for &photo in pair {
            partners[photo] += 1;
            if !placed[photo] {
                let counts = if within { &mut inner } else { &mut outer };
                counts[groups.of[photo]] += 1;
            }
        }
    }
    // A pair of a group was counted at both of its photographs.
    let is_apart = |photo: usize| {
        let group = groups.of[photo];
        let joined = groups.size(photo) >= MIN_JOINED_GROUP && inner[group] / 2 > outer[group];
        groups.size(photo) > 1 && (outer[group] == 0 || joined)
    };
    let out = |photo: &usize| !placed[*photo];
    let misfits = (0..placed.len()).filter(out).filter(|&p| partners[p] > 0 && !is_apart(p));
    let numbers: Vec<usize> = misfits.map(|photo| partners[photo]).collect();
    let least = numbers.iter().min().copied().unwrap_or(0);
    // One reason for all of them, so that a message can join their lines.
    let at_least = if numbers.iter().all(|n| *n == least) { "" } else { "at least " };
    let reason = |photo: usize| {
        let (size, group) = (groups.size(photo), groups.of[photo]);
        if partners[photo] == 0 {
            "no other photograph has enough in common with it".to_owned()
        } else if !is_apart(photo) {
            format!(
                "it matches {at_least}{least} photograph(s), but its points do not fit the others"
            )
        } else if outer[group] == 0 {
            format!(
                "it belongs to another group of {size} photographs, which share no points with the \
                 {used} that are used"
            )
        } else {
            format!(
                "it belongs to another group of {size} photographs, whose points do not fit those of \
                 the {used} that are used"
            )
        }
    };
    (0..placed.len()).filter(out).map(|photo| LeftOut { photo, reason: reason(photo) }).collect()
}

/// One sentence, without a final full stop, for each reason of `left_out`, in the order of its first
/// photograph: with up to three names, which `name` gives for an index, then the number of the others.
pub(super) fn sentences(left_out: &[LeftOut], name: impl Fn(usize) -> String) -> Vec<String> {
    /// Names of a sentence.
    const NAMED: usize = 3;
    let mut reasons: Vec<(&str, Vec<usize>)> = Vec::new();
    for LeftOut { photo, reason } in left_out {
        match reasons.iter_mut().find(|(r, _)| r == reason) {
            Some((_, photos)) => photos.push(*photo),
            None => reasons.push((reason, vec![*photo])),
        }
    }
    let sentence = |(reason, photos): (&str, Vec<usize>)| {
        let mut names: Vec<String> = photos.iter().take(NAMED).map(|&p| name(p)).collect();
        match photos.len().saturating_sub(NAMED) {
            0 => {}
            1 => names.push("1 other".to_owned()),
            others => names.push(format!("{others} others")),
        }
        match names.split_last() {
            Some((last, [])) => format!("{last} is left out: {reason}"),
            Some((last, first)) => {
                format!("{} and {last} are left out, each because {reason}", first.join(", "))
            }
            None => String::new(),
        }
    };
    reasons.into_iter().map(sentence).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All pairs of `photos`.
    fn all(photos: std::ops::Range<usize>) -> Vec<[usize; 2]> {
        let end = photos.end;
        photos.flat_map(|i| (i + 1..end).map(move |j| [i, j])).collect()
    }

    #[test]
    fn pairs_join_photographs_to_groups() {
        let groups = Groups::new(6, [[4, 2], [0, 3], [2, 3]].into_iter());
        assert_eq!((0..6).map(|i| groups.size(i)).collect::<Vec<_>>(), [4, 1, 4, 4, 4, 1]);
    }

    #[test]
    fn a_group_apart_is_named_in_one_sentence() {
        let placed: Vec<bool> = (0..11).map(|i| i < 5).collect();
        let pairs = [all(0..5), all(5..10)].concat();
        let out = left_out(&placed, &pairs);
        assert_eq!(out.iter().map(|l| l.photo).collect::<Vec<_>>(), [5, 6, 7, 8, 9, 10]);
        assert_eq!(
            sentences(&out, |i| format!("{i}.jpg")),
            [
                "5.jpg, 6.jpg, 7.jpg and 2 others are left out, each because it belongs to another \
                 group of 5 photographs, which share no points with the 5 that are used",
                "10.jpg is left out: no other photograph has enough in common with it",
            ]
        );
        // A single wrong pair between the groups changes the reason, not the group.
        let out = left_out(&placed, &[pairs, vec![[0, 9]]].concat());
        let apart = "it belongs to another group of 5 photographs, whose points do not fit those of \
                     the 5 that are used";
        assert!(out[..5].iter().all(|l| l.reason == apart), "{out:?}");
    }

    #[test]
    fn photographs_that_do_not_fit_share_one_reason() {
        let placed: Vec<bool> = (0..7).map(|i| i < 5).collect();
        let mut pairs = all(0..5);
        pairs.extend([[0, 5], [1, 5], [2, 5], [0, 6], [1, 6], [5, 6]]);
        let out = left_out(&placed, &pairs);
        let reason = "it matches at least 3 photograph(s), but its points do not fit the others";
        assert_eq!(
            sentences(&out, |i| i.to_string()),
            [format!("5 and 6 are left out, each because {reason}")]
        );
        // Equal numbers are told exactly.
        pairs.pop();
        pairs.push([2, 6]);
        let out = left_out(&placed, &pairs);
        assert!(out.iter().all(|l| l.reason.starts_with("it matches 3 photograph(s)")), "{out:?}");
        let four = left_out(&placed, &[[0, 5], [1, 5]]);
        assert_eq!(four.len(), 2);
        assert!(four[0].reason.contains("matches 2 "), "{four:?}");
    }
}
