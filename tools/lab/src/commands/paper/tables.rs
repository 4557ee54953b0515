//! The paper's tables and figures as data: settings, rows, and the configuration of each row.
//!
//! Their numbers are in `published.csv`, under the same names.

/// Side of the network's input in the paper, px.
pub const INPUT: usize = 256;

/// A table or figure of the paper.
pub struct Table {
    /// Name in the paper: `t1` is Table 1, `tA` Table A of the supplement, `f3` Figure 3.
    pub id: &'static str,
    /// Subject.
    pub title: &'static str,
    /// Data and sizes; each row has numbers for each of them.
    pub settings: &'static [Setting],
    /// Compared methods, in the paper's order.
    pub rows: &'static [Row],
    /// Output.
    pub kind: Kind,
    /// Remark on what differs from the paper.
    pub note: &'static str,
}

/// Output of a table or figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// PSNR, SSIM and LPIPS.
    Scores,
    /// Scores and seconds.
    ScoresAndSeconds,
    /// Scores, seconds and memory.
    ScoresAndCost,
    /// Seconds and memory.
    Cost,
    /// Pictures side by side, and their scores.
    Pictures,
    /// A video, and stills of it.
    Video,
}

impl Kind {
    /// Returns whether pictures are scored.
    pub fn has_scores(self) -> bool {
        !matches!(self, Self::Cost | Self::Video)
    }

    /// Returns whether seconds are printed.
    pub fn has_seconds(self) -> bool {
        matches!(self, Self::ScoresAndSeconds | Self::ScoresAndCost | Self::Cost)
    }

    /// Returns whether memory is measured.
    pub fn has_memory(self) -> bool {
        matches!(self, Self::ScoresAndCost | Self::Cost)
    }
}

/// A data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Data {
    /// RealEstate10K.
    Re10k,
    /// ACID.
    Acid,
}

/// Data and sizes of an evaluation.
pub struct Setting {
    /// Name in the tables: the data set and the side of the targets in the paper.
    pub label: &'static str,
    /// Data set.
    pub data: Data,
    /// Side of the targets over that of the inputs.
    pub upscale: usize,
}

impl Setting {
    /// Names of the folder that holds the data, the first that exists: pictures of 1080 lines for
    /// targets of 1024 px.
    pub fn folders(&self) -> &'static [&'static str] {
        match (self.data, self.upscale) {
            (Data::Re10k, 4) => &["re10k-1080"],
            (Data::Re10k, _) => &["re10k-720", "re10k"],
            (Data::Acid, 4) => &["acid-1080"],
            (Data::Acid, _) => &["acid-720", "acid"],
        }
    }

    /// Name of a folder: `re10k-512`.
    pub fn slug(&self) -> String {
        slug(self.label)
    }
}

/// A name in lower case, with a hyphen for each run of other characters than letters and digits.
pub fn slug(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|w| !w.is_empty());
    words.map(str::to_ascii_lowercase).collect::<Vec<_>>().join("-")
}

/// A method of a table.
pub struct Row {
    /// Name in the tables.
    pub name: &'static str,
    /// Source of its pictures.
    pub source: Source,
}

/// Source of a row's pictures.
#[derive(Clone, Copy)]
pub enum Source {
    /// Another program's, by `--pred NAME=DIR`.
    Imported,
    /// One of `eval`'s methods, with the weights of that name of `--ckpts`, or the shipped ones.
    Method(Weights, &'static str),
    /// The same, whose inputs have the size of the targets.
    MethodAtTargetSize(Weights, &'static str),
    /// SubSplat's heads of a configuration, trained here unless `--ckpts` has them.
    Trained(&'static Variant),
}

/// Weights that are not trained here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Weights {
    /// MVSplat's.
    Mvsplat,
    /// SubSplat's.
    Subsplat,
}

impl Weights {
    /// Name of the file in the folder of `--ckpts`, without the upscale.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mvsplat => "mvsplat",
            Self::Subsplat => "subsplat",
        }
    }
}

/// A configuration of the network that differs from the preset `paper`.
pub struct Variant {
    /// Name of its weights.
    pub name: &'static str,
    /// Keys of the configuration that differ, as JSON.
    pub change: &'static str,
}

const FULL: Variant = Variant { name: "full", change: "{}" };
const NO_AGGREGATION: Variant =
    Variant { name: "no-aggregation", change: r#"{"agg": {"enabled": false}}"# };
const STAGE_1: Variant = Variant { name: "stages-1", change: r#"{"agg": {"stages_geo": 1}}"# };
const STAGES_2: Variant = Variant { name: "stages-2", change: r#"{"agg": {"stages_geo": 2}}"# };
const BETA_50: Variant = Variant { name: "beta-z-50", change: r#"{"spgr": {"beta_z": 0.5}}"# };
const BETA_75: Variant = Variant { name: "beta-z-75", change: r#"{"spgr": {"beta_z": 0.75}}"# };
const BETA_100: Variant = Variant { name: "beta-z-100", change: r#"{"spgr": {"beta_z": 1.0}}"# };
const LAMBDA_50: Variant =
    Variant { name: "lambda-s-50", change: r#"{"spgr": {"lambda_s": {"value": 0.5}}}"# };
const LAMBDA_55: Variant =
    Variant { name: "lambda-s-55", change: r#"{"spgr": {"lambda_s": {"value": 0.55}}}"# };
const LAMBDA_65: Variant =
    Variant { name: "lambda-s-65", change: r#"{"spgr": {"lambda_s": {"value": 0.65}}}"# };
const LAMBDA_70: Variant =
    Variant { name: "lambda-s-70", change: r#"{"spgr": {"lambda_s": {"value": 0.7}}}"# };
const GAIN_50: Variant = Variant { name: "gain-50", change: r#"{"spgr": {"delta": 0.5}}"# };
const GAIN_0: Variant = Variant { name: "gain-0", change: r#"{"spgr": {"delta": 0.0}}"# };

const RE10K_512: Setting = Setting { label: "RE10K 512", data: Data::Re10k, upscale: 2 };
const RE10K_1024: Setting = Setting { label: "RE10K 1024", data: Data::Re10k, upscale: 4 };
const ACID_512: Setting = Setting { label: "ACID 512", data: Data::Acid, upscale: 2 };
const ACID_1024: Setting = Setting { label: "ACID 1024", data: Data::Acid, upscale: 4 };

const fn imported(name: &'static str) -> Row {
    Row { name, source: Source::Imported }
}

const fn mvsplat(name: &'static str, method: &'static str) -> Row {
    Row { name, source: Source::Method(Weights::Mvsplat, method) }
}

const fn subsplat(name: &'static str, method: &'static str) -> Row {
    Row { name, source: Source::Method(Weights::Subsplat, method) }
}

const fn trained(name: &'static str, variant: &'static Variant) -> Row {
    Row { name, source: Source::Trained(variant) }
}

const fn at_target_size(name: &'static str) -> Row {
    Row { name, source: Source::MethodAtTargetSize(Weights::Mvsplat, "backbone") }
}

/// The pictures of `subsplat run`.
const REFINED: Row = subsplat("SubSplat, fitted and refined", "refine");
/// The same at the input's size, enlarged: the strongest rival of children.
const ENLARGED: Row = subsplat("SubSplat at the input's size, refined + Lanczos", "enlarged");

/// Rows of Table 1, which its figures show too.
const SCALES: &[Row] = &[
    imported("pixelSplat"),
    mvsplat("MVSplat", "backbone"),
    mvsplat("MVSplat, low-pass of the input", "lowpass"),
    imported("TranSplat"),
    imported("DepthSplat"),
    imported("HiSplat"),
    subsplat("SubSplat", "subsplat"),
    REFINED,
];

const UPSAMPLERS: &[Row] = &[
    mvsplat("MVSplat + bilinear", "bilinear"),
    imported("MVSplat + HiT-SR"),
    subsplat("SubSplat", "subsplat"),
    REFINED,
    ENLARGED,
];

/// [`UPSAMPLERS`] at x4.
const UPSAMPLERS_X4: &[Row] = &[
    mvsplat("MVSplat + bilinear", "bilinear"),
    imported("MVSplat + HiT-SR"),
    subsplat("SubSplat", "subsplat"),
    REFINED,
    ENLARGED,
    subsplat("SubSplat at half the upscale, refined + Lanczos", "half"),
];

const MODULES: &[Row] = &[
    mvsplat("MVSplat", "backbone"),
    trained("+ sub-pixel reparameterization", &NO_AGGREGATION),
    trained("+ feature aggregation (SubSplat)", &FULL),
];

const OWN_ROWS: &str =
    "The rows \"low-pass of the input\" and \"fitted and refined\" are not in the paper.";
const OWN_UPSAMPLERS: &str = "The rows with \"refined\" are not in the paper.";
const OVERRIDES: &str =
    "Each row is trained with its own value; the paper does not say whether its rows were.";

/// The tables and figures that the specification describes. Figures 1 and 2 are drawings; a Table 6
/// is not described.
pub const TABLES: &[Table] = &[
    Table {
        id: "t1",
        title: "Scalability: targets of two and four times the input's size",
        settings: &[RE10K_512, RE10K_1024, ACID_512, ACID_1024],
        rows: SCALES,
        kind: Kind::Scores,
        note: OWN_ROWS,
    },
    Table {
        id: "t2",
        title: "Cost and quality: pictures of 512 px from inputs of 512 px and of 256 px",
        settings: &[RE10K_512],
        rows: &[
            imported("pixelSplat"),
            at_target_size("MVSplat (input 512)"),
            imported("TranSplat"),
            imported("DepthSplat"),
            imported("HiSplat"),
            subsplat("SubSplat", "subsplat"),
        ],
        kind: Kind::ScoresAndCost,
        note: "",
    },
    Table {
        id: "t3",
        title: "Upsampled pictures and sub-pixel Gaussians, x2",
        settings: &[RE10K_512],
        rows: UPSAMPLERS,
        kind: Kind::ScoresAndSeconds,
        note: OWN_UPSAMPLERS,
    },
    Table {
        id: "t4",
        title: "Modules",
        settings: &[RE10K_512, RE10K_1024],
        rows: MODULES,
        kind: Kind::Scores,
        note: "The paper's text says that MVSplat was trained with targets of high resolution here; its \
               numbers are those of Table 1, of MVSplat as released. Here it is the backbone alone.",
    },
    Table {
        id: "t5",
        title: "Stages of the feature aggregation",
        settings: &[RE10K_512],
        rows: &[
            trained("1 stage", &STAGE_1),
            trained("2 stages", &STAGES_2),
            trained("3 stages", &FULL),
        ],
        kind: Kind::Scores,
        note: "In the paper no aggregation at all (Table 4, 25.15 dB) is better than one or two stages.",
    },
    Table {
        id: "tA",
        title: "Bound of the depth residual",
        settings: &[RE10K_512],
        rows: &[
            trained("beta_z .25", &FULL),
            trained("beta_z .50", &BETA_50),
            trained("beta_z .75", &BETA_75),
            trained("beta_z 1.0", &BETA_100),
        ],
        kind: Kind::Scores,
        note: OVERRIDES,
    },
    Table {
        id: "tB",
        title: "Factor of the children's scales",
        settings: &[RE10K_512],
        rows: &[
            trained("lambda_s .50", &LAMBDA_50),
            trained("lambda_s .55", &LAMBDA_55),
            trained("lambda_s .60", &FULL),
            trained("lambda_s .65", &LAMBDA_65),
            trained("lambda_s .70", &LAMBDA_70),
        ],
        kind: Kind::Scores,
        note: OVERRIDES,
    },
    Table {
        id: "tC",
        title: "Range of the colour gain",
        settings: &[RE10K_512],
        rows: &[
            trained("gain [.5, 1.5]", &GAIN_50),
            trained("gain [.75, 1.25]", &FULL),
            trained("gain [1, 1]", &GAIN_0),
        ],
        kind: Kind::Scores,
        note: OVERRIDES,
    },
    Table {
        id: "tD",
        title: "Uniform density: K Gaussians a pixel without sub-pixel reparameterization",
        settings: &[RE10K_512, RE10K_1024],
        rows: &[mvsplat("MVSplat x K", "uniform"), subsplat("SubSplat", "subsplat")],
        kind: Kind::Scores,
        note: "Here the K Gaussians are an even split of the backbone's; the paper trains MVSplat to \
               predict K a pixel.",
    },
    Table {
        id: "tE",
        title: "Efficiency: pictures of 512 px",
        settings: &[RE10K_512],
        rows: &[
            imported("pixelSplat (input 256)"),
            imported("pixelSplat (input 512)"),
            imported("TranSplat (input 256)"),
            imported("TranSplat (input 512)"),
            mvsplat("MVSplat (input 256)", "backbone"),
            at_target_size("MVSplat (input 512)"),
            imported("HiSplat (input 256)"),
            imported("HiSplat (input 512)"),
            imported("DepthSplat (input 256)"),
            imported("DepthSplat (input 512)"),
            subsplat("SubSplat (input 256)", "subsplat"),
            REFINED,
            ENLARGED,
        ],
        kind: Kind::Cost,
        note: OWN_UPSAMPLERS,
    },
    Table {
        id: "tF",
        title: "Upsampled pictures and sub-pixel Gaussians, x4",
        settings: &[RE10K_1024],
        rows: UPSAMPLERS_X4,
        kind: Kind::ScoresAndSeconds,
        note: OWN_UPSAMPLERS,
    },
    figure("f3", "Views of RealEstate10K at 512 px", &[RE10K_512], SCALES, FIGURES),
    figure("f4", "Views of RealEstate10K at 1024 px", &[RE10K_1024], SCALES, FIGURES),
    figure("f5", "Views beside upsampled pictures, x2", &[RE10K_512], UPSAMPLERS, ""),
    figure("f6", "Views of the modules", &[RE10K_512], MODULES, ""),
    figure("fA", "Views beside upsampled pictures, x4", &[RE10K_1024], UPSAMPLERS_X4, ""),
    Table {
        id: "fB",
        title: "Video between the two inputs",
        settings: &[RE10K_512],
        rows: &[mvsplat("MVSplat", "backbone"), subsplat("SubSplat", "subsplat")],
        kind: Kind::Video,
        note: "MVSplat to the left, SubSplat to the right.",
    },
    figure("fC", "Views of ACID at 512 px", &[ACID_512], SCALES, FIGURES),
    figure("fD", "Views of ACID at 1024 px", &[ACID_1024], SCALES, FIGURES),
];

const FIGURES: &str = "The specification names Figures 3, 4, C and D together, as views at 512 and \
                       1024 px; the data set and size of each are this program's choice.";

const fn figure(
    id: &'static str,
    title: &'static str,
    settings: &'static [Setting],
    rows: &'static [Row],
    note: &'static str,
) -> Table {
    Table { id, title, settings, rows, kind: Kind::Pictures, note }
}
