//! Selection of tensors from the inputs, with the names to write.
//!
//! Converted MVSplat weights carry the `tuned` ×2 configuration, which `run` assumes in any case.

use crate::convert::args::Args;
use crate::convert::source::{Content, Entry, Source};
use anyhow::{Context, Result, bail, ensure};
use std::collections::BTreeMap;
use subsplat::network::config::{Config, Preset};
use subsplat::network::model::architecture::{Kind, Shapes, expected, guess_config};

/// Result of the comparison of names and shapes with the architecture.
pub struct Plan {
    pub kind: Kind,
    /// True if the names, not the user, determined the kind.
    pub recognised: bool,
    /// Configuration for the metadata (`mvsplat`, `subsplat`).
    pub config: Option<Config>,
    /// Index of the source and of its entry, by the name to write.
    pub taken: BTreeMap<String, (usize, usize)>,
    /// Names of the architecture that no input has.
    pub missing: Vec<String>,
    /// Float tensors and other values that the architecture does not have.
    pub unexpected: Vec<String>,
    /// Known names that no model here has, and names without the prefix.
    pub not_needed: Vec<String>,
    /// Integer tensors.
    pub integers: Vec<String>,
}

/// An entry of an input, by the source's name without `--prefix`.
struct Named<'a> {
    name: &'a str,
    at: (usize, usize),
    entry: &'a Entry,
}

/// Decides everything but the elements.
pub fn plan(args: &Args, sources: &[Source]) -> Result<Plan> {
    let (entries, outside) = named(sources, &args.prefix);
    let file = files(sources);
    let recognised = Kind::recognise(entries.iter().map(|e| e.name));
    let Some(kind) = args.kind.kind().or(recognised) else {
        let first = entries.iter().map(|e| e.name).chain(outside.iter().map(|n| &**n)).next();
        bail!(
            "{file}: expected names of mvsplat, subsplat, gmdepth or lpips{}, got {} tensors{}",
            if args.prefix.is_empty() { "" } else { " behind --prefix" },
            entries.len(),
            first.map(|n| format!(", first `{n}`")).unwrap_or_default()
        );
    };
    ensure!(
        args.lpips_linear.is_none() || kind == Kind::Lpips,
        "--lpips-linear: expected weights of kind lpips, got {}",
        kind.name()
    );
    let config = config(args, kind, &entries, sources)?;
    let fallback = || Config::re10k(Preset::Tuned, 2);
    let wanted = expected(kind, &config.clone().unwrap_or_else(fallback))?;
    let mut plan = Plan {
        kind,
        recognised: args.kind.kind().is_none(),
        config,
        taken: BTreeMap::new(),
        missing: Vec::new(),
        unexpected: Vec::new(),
        not_needed: outside,
        integers: Vec::new(),
    };
    plan.sort_out(&entries, &wanted, &file)?;
    plan.judge(args, &wanted, recognised, &file)?;
    Ok(plan)
}

/// Separates entries whose names begin with `prefix` from the other names.
fn named<'a>(sources: &'a [Source], prefix: &str) -> (Vec<Named<'a>>, Vec<String>) {
    let (mut entries, mut outside) = (Vec::new(), Vec::new());
    for (s, source) in sources.iter().enumerate() {
        // The prefix applies to the first input; linear weights have the package's own names.
        let prefix = if s == 0 { prefix } else { "" };
        for (e, entry) in source.entries.iter().enumerate() {
            match entry.name.strip_prefix(prefix) {
                Some(name) => entries.push(Named { name, at: (s, e), entry }),
                None => outside.push(entry.name.clone()),
            }
        }
    }
    (entries, outside)
}

/// The inputs' paths, for messages.
fn files(sources: &[Source]) -> String {
    let paths: Vec<String> = sources.iter().map(|s| s.path.display().to_string()).collect();
    paths.join(" and ")
}

/// Determines the configuration for the metadata; `None` for parts of a model.
fn config(
    args: &Args,
    kind: Kind,
    entries: &[Named],
    sources: &[Source],
) -> Result<Option<Config>> {
    if matches!(kind, Kind::Gmdepth | Kind::Lpips) {
        let given = args.config.is_some() || args.preset.is_some() || args.upscale.is_some();
        let name = kind.name();
        ensure!(!given, "--config, --preset, --upscale: expected a whole model, got kind {name}");
        return Ok(None);
    }
    if let Some(path) = &args.config {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        let config = Config::from_json(&text).with_context(|| path.display().to_string())?;
        return Ok(Some(config));
    }
    let mut shapes = Shapes::new();
    for named in entries {
        if let Content::Floats { shape, .. } = &named.entry.content {
            shapes.insert(kind.canonical(named.name), shape.clone());
        }
    }
    let stored = sources.iter().find_map(|s| s.config.clone());
    let base = match stored {
        Some(config) => config,
        None => guess_config(&shapes)?,
    };
    let upscale = args.upscale.unwrap_or(base.upscale);
    let config = match args.preset {
        Some(preset) => base.with_preset(preset, upscale),
        None => Config { upscale, ..base },
    };
    config.check().context("--upscale")?;
    Ok(Some(config))
}

impl Plan {
    /// Puts every entry into one of the lists. A known name with a wrong content or shape is an
    /// error.
    fn sort_out(&mut self, entries: &[Named], wanted: &Shapes, file: &str) -> Result<()> {
        let mut misshaped = Vec::new();
        for Named { name, at, entry } in entries {
            let canonical = self.kind.canonical(name);
            match (wanted.get(&canonical), &entry.content) {
                (Some(shape), Content::Floats { shape: got, .. }) => {
                    if got != shape {
                        misshaped.push(format!("`{name}`: expected shape {shape:?}, got {got:?}"));
                    }
                    if self.taken.insert(canonical, *at).is_some() {
                        bail!("{file} tensor `{name}`: expected each weight once, got it again");
                    }
                }
                (Some(_), Content::Integers(got) | Content::Other(got)) => {
                    bail!("{file} `{name}`: expected a tensor of floats, got {got}")
                }
                (None, _) if self.kind.leaves_out(name) => self.not_needed.push(entry.name.clone()),
                (None, Content::Integers(_)) => self.integers.push(entry.name.clone()),
                (None, _) => self.unexpected.push(entry.name.clone()),
            }
        }
        if let Some(first) = misshaped.first() {
            let more = match misshaped.len() - 1 {
                0 => String::new(),
                n => format!(" (and {n} more)"),
            };
            bail!("{file} tensor {first}{more}");
        }
        let missing = wanted.keys().filter(|n| !self.taken.contains_key(*n));
        self.missing = missing.cloned().collect();
        Ok(())
    }

    /// Rejects a result that the arguments do not allow.
    fn judge(
        &self,
        args: &Args,
        wanted: &Shapes,
        recognised: Option<Kind>,
        file: &str,
    ) -> Result<()> {
        let kind = self.kind.name();
        let first = |names: &[String]| names.first().cloned().unwrap_or_default();
        if self.taken.is_empty() {
            let like = match recognised.filter(|r| *r != self.kind) {
                Some(other) => format!(" (they look like {})", other.name()),
                None => String::new(),
            };
            let such = wanted.keys().next().map_or("", String::as_str);
            bail!("{file}: expected names of kind {kind} such as `{such}`, got others{like}");
        }
        if args.strict && !self.unexpected.is_empty() {
            let n = self.unexpected.len();
            let first = first(&self.unexpected);
            bail!(
                "{file}: expected the names of kind {kind} alone, got {n} others, first `{first}`"
            );
        }
        if self.missing.is_empty() || args.allow_missing {
            return Ok(());
        }
        let linear = self.kind == Kind::Lpips && self.missing.iter().all(|n| n.starts_with("lin"));
        bail!(
            "{file}: expected {} tensors of kind {kind}, got {} of them; the first missing one is \
             `{}` ({})",
            wanted.len(),
            self.taken.len(),
            first(&self.missing),
            if linear {
                "--lpips-linear names the file of LPIPS' linear weights"
            } else {
                "--allow-missing writes the others"
            }
        );
    }
}
