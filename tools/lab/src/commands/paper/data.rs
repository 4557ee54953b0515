//! The data sets of the tables, or generated scenes in their place.

use super::tables::{Data, INPUT, Setting};
use crate::eval::Benchmark;
use crate::train::TrainConfig;
use crate::train::folders::write_scene;
use crate::train::source::Source;
use crate::train::validate::{Split, rooms};
use anyhow::{Context, Result};
use std::path::{Path, PathBuf};
use subsplat_cli::report::Progress;

/// Side of the network's input for generated scenes, px. Scenes for 256 px take four times as long.
pub const GENERATED_INPUT: usize = 128;
/// Seed of the generated scenes, which no training uses.
const SEED: u64 = 77;
/// Targets of a generated scene.
const TARGETS: usize = 2;
/// Samples along each side of a pixel.
const SAMPLES: usize = 2;
/// Folders of `--data`.
const FOLDERS: [&str; 6] = ["re10k", "re10k-720", "re10k-1080", "acid", "acid-720", "acid-1080"];

/// The data of the arguments.
pub struct Sets<'a> {
    /// `--data`.
    pub root: Option<&'a Path>,
    /// `--input-size`.
    pub input: Option<usize>,
    /// `--limit`.
    pub scenes: usize,
    /// Folder for generated scenes.
    pub generated: PathBuf,
}

/// Data of a setting.
pub struct Opened {
    /// The cases.
    pub benchmark: Benchmark,
    /// Name of the data in the tables.
    pub name: String,
    /// True for generated scenes.
    pub generated: bool,
    /// Side of the network's input, px.
    pub input: usize,
}

impl Sets<'_> {
    /// Opens the data of a setting. Where its folder is absent, scenes are generated for inputs of
    /// `generated_input` px.
    ///
    /// # Errors
    /// Data that cannot be read; a scene that cannot be written.
    pub fn open(
        &self,
        setting: &Setting,
        generated_input: usize,
        progress: &mut Progress,
    ) -> Result<Opened> {
        let mut opened = match self.folder(setting) {
            Some(folder) => {
                let index = folder.with_extension("json");
                let index = Some(index.as_path()).filter(|file| file.is_file());
                let name = folder.file_name().unwrap_or(folder.as_os_str()).to_string_lossy();
                Opened {
                    benchmark: Benchmark::open(&folder, index)?,
                    name: name.into_owned(),
                    generated: false,
                    input: self.input.unwrap_or(INPUT),
                }
            }
            None => {
                let input = self.input.unwrap_or(generated_input);
                let folder = self.scenes(setting.data, input * setting.upscale, progress)?;
                let name = match setting.data {
                    Data::Re10k => "generated rooms",
                    Data::Acid => "generated shapes",
                };
                Opened {
                    benchmark: Benchmark::open(&folder, None)?,
                    name: name.to_owned(),
                    generated: true,
                    input,
                }
            }
        };
        opened.benchmark.limit(self.scenes);
        Ok(opened)
    }

    /// The folder of a setting's data: that of the data set in `root`; `root` itself if it holds no
    /// data set by name.
    fn folder(&self, setting: &Setting) -> Option<PathBuf> {
        let root = self.root?;
        if !FOLDERS.iter().any(|name| root.join(name).is_dir()) {
            return Some(root.to_owned());
        }
        setting.folders().iter().map(|name| root.join(name)).find(|folder| folder.is_dir())
    }

    /// Generates scenes with pictures of `side` px, unless their folder has them: furnished rooms, or,
    /// in place of ACID, shapes at random places, indoors and outdoors. Returns the folder.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn scenes(&self, data: Data, side: usize, progress: &mut Progress) -> Result<PathBuf> {
        let (kind, shapes) = match data {
            Data::Re10k => ("rooms", 0.0),
            Data::Acid => ("shapes", 1.0),
        };
        let folder = self.generated.join(format!("{kind}-{side}px"));
        let mut config = TrainConfig::default();
        config.model.upscale = 1;
        config.data.input = [side, side];
        config.data.targets = TARGETS;
        config.data.target_samples = SAMPLES;
        config.data.seed = SEED;
        (config.data.scattered, config.data.wide) = (shapes, shapes);
        let source = rooms(&config, Split::HeldOut)?;
        let place = |i: usize| folder.join(format!("scene_{i:03}"));
        let missing = |i: &usize| !place(*i).join("protocol.json").is_file();
        let new: Vec<usize> = (0..self.scenes).filter(missing).collect();
        progress.steps("generated scenes", new.len(), |bar| {
            for i in &new {
                let place = place(*i);
                let write = || write_scene(&*source.example(*i as u64)?, &place);
                write().with_context(|| place.display().to_string())?;
                bar.inc(1);
            }
            Ok::<_, anyhow::Error>(())
        })?;
        Ok(folder)
    }
}
