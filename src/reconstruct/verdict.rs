//! The verdict on a finished scene, in one sentence.
//!
//! The thresholds were chosen on pairs and fives of four scenes of `../shared/photos` (fox, hololens_table, re10k_0bf,
//! re10k_0f68) with true cameras, and with wrong rotations, positions, focal lengths or photographs. Quality is the PSNR
//! of views between the photographs over that of a copy of the nearer one. On the other four scenes, 256 px, 52 cases:
//!
//! | verdict | cases | below 3 dB | 3 to 5 dB | 5 dB and more |
//! |---|---|---|---|---|
//! | good | 11 | 2 | 2 | 7 |
//! | usable near the photographs | 21 | 15 | 4 | 2 |
//! | wrong | 20 | 20 | 0 | 0 |
//!
//! With true cameras 6 of 11 are good and 5 usable; the two good ones below 3 dB have cameras that the check calls
//! imprecise.

use super::Agreement;
use crate::cameras::check::PairReport;
use serde::Serialize;
use std::fmt;

/// Below it a scene is wrong: [`Agreement::consistent`].
const WRONG_CONSISTENT: f64 = 0.15;
/// The same where the check found that the cameras do not fit, and [`Agreement::gain`], dB.
const DOUBTED_CONSISTENT: f64 = 0.3;
const DOUBTED_GAIN: f64 = 3.0;
/// Least values of a good scene.
const GOOD_CONSISTENT: f64 = 0.4;
const GOOD_GAIN: f64 = 5.0;
/// Least share of the photographs that others show, below which nothing can be said of the surfaces.
const LEAST_SHARED: f64 = 0.2;
/// Least parallax of a good scene, share of the picture's width.
const LEAST_PARALLAX: f64 = 0.04;
/// Least mean alpha of a good scene's pictures at its inputs' cameras.
const LEAST_COVERAGE: f64 = 0.85;

/// Trust in a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Trust {
    /// The photographs agree on most of the surfaces that they share.
    Good,
    /// Views near the photographs are right; farther ones show wrong shapes or gaps.
    NearPhotographs,
    /// The surfaces are not those that the photographs show, although each photograph may look right.
    Wrong,
}

/// The verdict on a scene. [`fmt::Display`] gives one sentence without a final full stop: the verdict, the likeliest
/// cause and what to do about it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct SceneVerdict {
    /// Trust in the scene.
    pub trust: Trust,
    /// The likeliest cause, and what to do; the agreement of a good scene.
    pub reason: String,
}

impl fmt::Display for SceneVerdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let trust = match self.trust {
            Trust::Good => "good",
            Trust::NearPhotographs => "usable near the photographs",
            Trust::Wrong => "wrong",
        };
        write!(f, "{trust}: {}", self.reason)
    }
}

impl SceneVerdict {
    /// Judges a scene by its agreement, the mean alpha of its pictures and the checks of its cameras.
    pub(super) fn new(agreement: &Agreement, coverage: f64, reports: &[PairReport]) -> Self {
        let finding = |code: &str| {
            let mut all = reports.iter().flat_map(|r| &r.findings);
            all.find(|f| f.code == code).map(|f| f.sentence.as_str())
        };
        let misfit = finding("poses_wrong");
        let Agreement { consistent, shared, parallax, .. } = *agreement;
        let low = consistent < DOUBTED_CONSISTENT || agreement.gain() < DOUBTED_GAIN;
        let good = consistent >= GOOD_CONSISTENT && agreement.gain() >= GOOD_GAIN;
        let agree = format!(
            "the photographs agree on {} of the surfaces that they share",
            percent(consistent)
        );
        let (trust, reason) = if shared < LEAST_SHARED {
            let reason = match misfit {
                Some(_) => cause_of_wrong(misfit),
                None if coverage < LEAST_COVERAGE => few_splats(coverage),
                None => little_shared(shared),
            };
            (Trust::Wrong, reason)
        } else if consistent < WRONG_CONSISTENT || misfit.is_some() && low {
            (Trust::Wrong, format!("{agree}; {}", cause_of_wrong(misfit)))
        } else if parallax < LEAST_PARALLAX {
            (Trust::NearPhotographs, little_parallax(parallax))
        } else if coverage < LEAST_COVERAGE {
            (Trust::NearPhotographs, little_coverage(coverage))
        } else if misfit.is_some() || !good {
            let cause = cause_of_doubt(misfit.or_else(|| finding("poses_imprecise")));
            (Trust::NearPhotographs, format!("{agree}; {cause}"))
        } else {
            (Trust::Good, agree)
        };
        Self { trust, reason }
    }
}

fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

fn little_shared(shared: f64) -> String {
    format!(
        "the photographs share {} of what they show; take photographs that show most of the same things",
        percent(shared)
    )
}

fn few_splats(coverage: f64) -> String {
    format!(
        "the splats cover {} of the photographs, so that nothing can be said of the surfaces; more splats, or more \
         photographs of the same things, fill the gaps",
        percent(coverage)
    )
}

fn cause_of_wrong(misfit: Option<&str>) -> String {
    match misfit {
        Some(sentence) => format!(
            "the cameras are the likeliest cause ({sentence}); the program estimates them from the photographs alone, \
             without the file of cameras"
        ),
        None => "the likeliest causes are things that moved, photographs of different places, or wrong cameras; \
                 other photographs may help"
            .to_owned(),
    }
}

fn little_parallax(parallax: f64) -> String {
    format!(
        "things move by {:.1} % of the width between the photographs; photographs taken farther apart give better \
         distances",
        100.0 * parallax
    )
}

fn little_coverage(coverage: f64) -> String {
    format!(
        "the splats cover {} of the photographs; more photographs fill the gaps",
        percent(coverage)
    )
}

fn cause_of_doubt(finding: Option<&str>) -> String {
    match finding {
        Some(sentence) => {
            format!(
                "{sentence}; without the file of cameras, the program estimates them from the photographs"
            )
        }
        None => "photographs taken closer together agree better".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cameras::check::{Finding, Verdict};

    fn agreement(consistent: f64, gain: f64) -> Agreement {
        let (over_surface, at_same_place) = (10.0 + gain, 10.0);
        Agreement { shared: 0.7, consistent, over_surface, at_same_place, parallax: 0.1 }
    }

    fn report(code: &str) -> PairReport {
        let sentence = "the lines miss the points by 9 px".to_owned();
        let finding = Finding { severity: Verdict::Bad, code: code.to_owned(), sentence };
        PairReport { findings: vec![finding], ..PairReport::default() }
    }

    #[test]
    fn each_kind_of_scene_has_its_verdict() {
        let judge = |agreement: &Agreement, coverage: f64, reports: &[PairReport]| {
            SceneVerdict::new(agreement, coverage, reports)
        };
        let (wrong, near, good) = (Trust::Wrong, Trust::NearPhotographs, Trust::Good);
        let poses = [PairReport::default(), report("poses_wrong")];
        let cases = [
            (agreement(0.7, 8.0), 0.95, &[][..], good, "agree on 70 %"),
            (agreement(0.7, 3.0), 0.95, &[], near, "closer together"),
            (agreement(0.3, 8.0), 0.95, &[], near, "agree on 30 %"),
            (agreement(0.1, 8.0), 0.95, &[], wrong, "things that moved"),
            (agreement(0.7, 8.0), 0.5, &[], near, "cover 50 %"),
            (agreement(0.7, 8.0), 0.95, &poses, near, "miss the points by 9 px; without the file"),
            (agreement(0.25, 8.0), 0.95, &poses, wrong, "miss the points by 9 px"),
            (agreement(0.7, 2.0), 0.95, &poses, wrong, "without the file of cameras"),
            (agreement(0.3, 8.0), 0.95, &[report("poses_imprecise")], near, "without the file"),
        ];
        for (agreement, coverage, reports, trust, words) in cases {
            let verdict = judge(&agreement, coverage, reports);
            assert_eq!(verdict.trust, trust, "{verdict}");
            assert!(verdict.to_string().contains(words), "{verdict}");
        }
        let mut still = agreement(1.0, 12.0);
        still.parallax = 0.011;
        let verdict = judge(&still, 0.95, &[]);
        assert!(verdict.trust == near && verdict.to_string().contains("1.1 % of the width"));
        let mut apart = agreement(1.0, 12.0);
        apart.shared = 0.1;
        let cause = |coverage, reports: &[PairReport]| {
            let verdict = judge(&apart, coverage, reports);
            assert_eq!(verdict.trust, wrong);
            verdict.reason
        };
        assert!(cause(0.95, &[]).contains("share 10 %"));
        // Photographs that share little for another reason are not blamed.
        assert!(cause(0.95, &poses).contains("cameras are the likeliest cause"));
        assert!(cause(0.12, &[]).contains("splats cover 12 %"));
        // A scene that no photograph shares with another one has no agreement at all.
        assert_eq!(judge(&Agreement::default(), 0.0, &[]).trust, wrong);
    }

    /// Each threshold by cases 2 % below and above it and, where a number has no rounding, at it. The thresholds
    /// stand here as numbers, so that a change of a constant is seen.
    #[test]
    fn thresholds_are_where_the_table_was_measured() {
        let (wrong, near, good) = (Trust::Wrong, Trust::NearPhotographs, Trust::Good);
        let poses = [report("poses_wrong")];
        let of = |agreement: &Agreement, coverage: f64, reports: &[PairReport]| {
            SceneVerdict::new(agreement, coverage, reports).trust
        };
        let agreeing = |consistent, gain, reports: &[PairReport]| {
            of(&agreement(consistent, gain), 0.95, reports)
        };
        let by = |f: &dyn Fn(f64) -> Trust, at: f64| [0.98 * at, at, 1.02 * at].map(f);
        assert_eq!(by(&|v| agreeing(v, 8.0, &[]), 0.4), [near, good, good]);
        assert_eq!(by(&|v| agreeing(0.7, v, &[]), 5.0), [near, good, good]);
        assert_eq!(by(&|v| agreeing(v, 8.0, &[]), 0.15), [wrong, near, near]);
        assert_eq!(by(&|v| agreeing(v, 8.0, &poses), 0.3), [wrong, near, near]);
        assert_eq!(by(&|v| agreeing(0.7, v, &poses), 3.0), [wrong, near, near]);
        let shared = |shared| of(&Agreement { shared, ..agreement(0.7, 8.0) }, 0.95, &[]);
        assert_eq!(by(&shared, 0.2), [wrong, good, good]);
        let parallax = |parallax| of(&Agreement { parallax, ..agreement(0.7, 8.0) }, 0.95, &[]);
        assert_eq!(by(&parallax, 0.04), [near, good, good]);
        assert_eq!(by(&|v| of(&agreement(0.7, 8.0), v, &[]), 0.85), [near, good, good]);
    }
}
