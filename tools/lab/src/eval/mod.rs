//! Scores of a model on photographs that it was not trained on: PSNR, SSIM and LPIPS by the
//! protocol of MVSplat's and SubSplat's tables, sharpness and GMSD, with baselines in the same run.
//! [`InputReport`] scores the pictures at the inputs' own cameras and describes the Gaussians.
//!
//! ```no_run
//! use subsplat::network::config::{Config, Preset};
//! use subsplat_lab::eval::{Benchmark, Evaluator, Method, Options};
//! use subsplat::reconstruct::Reconstructor;
//! # fn main() -> subsplat::Result<()> {
//! let model = Reconstructor::untrained(&Config::small(Preset::Tuned, 2), 0)?;
//! let photos = Benchmark::open("photos".as_ref(), None)?;
//! let options = Options { methods: vec![Method::Subsplat, Method::Copy], ..Options::new(2.0) };
//! let scores = Evaluator::new(options).run(Some(&model), &photos)?;
//! println!("{:?} dB", scores.mean("subsplat").map(|s| s.psnr));
//! # Ok(())
//! # }
//! ```
//!
//! * [`Benchmark`] lists the views that are inputs and those that are ground truth: pixelSplat's
//!   chunks with an evaluation index, or scenes with `protocol.json` (or an index).
//! * [`Evaluator`] renders the same targets by every [`Method`], and scores the pictures.
//! * [`Scores`] holds one score per target, its mean over a case's targets, and the mean over
//!   cases. A case is one set of inputs. An index has one case per scene, a protocol.json may
//!   have several.
//!
//! Inputs have `input_size` pixels and targets r times as many a side, cropped from the
//! photograph as [`subsplat::reconstruct::inputs::crop`] describes. Some photographs are too small for such a
//! target. Their case's input is then halved until the target fits, or until half of the target would
//! be smaller than the nominal input. No score is therefore taken against enlarged pixels.

mod cases;
mod disturbance;
mod evaluator;
mod methods;
mod page;
mod pictures;
mod preparation;
mod score;
mod tables;

pub use cases::{Benchmark, Case, Loaded};
pub use disturbance::Disturbance;
pub use evaluator::{CaseResult, Evaluator, Options, TargetPictures};
pub use methods::Method;
pub use page::{Sheet, busiest, page};
pub use preparation::Preparation;
pub use score::{CaseScores, Scores, TargetScores};
pub use subsplat::scene::score::{GaussianReport, InputReport, Score};
pub use tables::{means_csv, report, targets_csv};
