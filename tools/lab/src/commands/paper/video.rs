//! The video of Figure B: views between the two inputs, and stills of it.

use super::Maker;
use super::sheet::paste;
use super::tables::Source;
use anyhow::{Context, Result, bail};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::io::Write as _;
use subsplat::files::photos::image::save_png;
use subsplat::files::write_atomic;
use subsplat::reconstruct::Check;
use subsplat::scene::pictures::Rgb;
use subsplat::{Detail, FitOptions, Options, Picture, Reconstruction, Refine};
use subsplat_cli::commands::frames::interpolate;
use subsplat_cli::commands::video::{Rate, Video};
use subsplat_cli::report::{Answer, Progress, print_line};
use subsplat_kernels::camera::{Camera, Size};

/// Frames between two stills.
const STILL_EVERY: usize = 20;
/// Frames a second.
const RATE: u32 = 25;

impl Maker<'_> {
    /// Reconstructs the first scene by each row, renders the views from the first input's camera to
    /// the second's, and writes video.webp, stills and a table of the views.
    pub(super) fn video(&mut self, progress: &mut Progress, answer: Answer) -> Result<Value> {
        let id = self.table.id;
        let [setting] = self.table.settings else { bail!("{id}: expected one setting") };
        let opened = self.open(setting, progress)?;
        let case = opened.benchmark.cases().first().context("the data hold no case")?;
        let loaded = opened.benchmark.load(case)?;
        let mut scenes = Vec::new();
        for row in self.table.rows {
            let chosen = self.models.choose(&row.source, setting.upscale, 0)?;
            let chosen = chosen.with_context(|| format!("{id}: {} has no model", row.name))?;
            // The backbone alone is the model with one child a pixel.
            let backbone = matches!(row.source, Source::Method(_, "backbone"));
            let model = chosen.load(setting.upscale)?;
            let model = if backbone { model.with_upscale(1)? } else { model };
            let side = opened.input * setting.upscale;
            let options = Options::default()
                .with_input_size(opened.input, opened.input)
                .with_target_size(subsplat::TargetSize::Exact(Size::new(side, side)))
                .with_depth_prior(Some(loaded.bounds.clone()))
                .with_check(Check::Off)
                .with_detail(Detail::Off)
                .with_refine(Refine::Off)
                .with_fit(FitOptions::default().with_steps(0));
            let label = format!("{id} {}", row.name);
            scenes.push(progress.stage(&label, |_| model.run(&loaded.context, &options))?);
        }
        let frames = self.args.frames;
        let cameras = match scenes.first() {
            Some(scene) => {
                let ends: Vec<Camera> = scene.inputs().iter().map(|c| c.target_camera).collect();
                interpolate(&ends, frames)?
            }
            None => bail!("{id}: expected a row, got none"),
        };
        let path = self.out.join("video.webp");
        let mut video: Option<Video> = None;
        let mut table = "frame,x,y,z,still\n".to_owned();
        let mut stills = 0;
        progress.steps(&format!("{id} views"), frames, |bar| {
            for (i, camera) in cameras.iter().enumerate() {
                let view = beside(&scenes, camera);
                let writer = match &mut video {
                    Some(video) => video,
                    None => {
                        let size = (view.width, view.height);
                        video.insert(Video::create(&path, size, Rate(RATE))?)
                    }
                };
                writer.push(&view)?;
                let still = (i % STILL_EVERY == 0).then(|| format!("still-{i:03}.png"));
                if let Some(name) = &still {
                    save_png(self.out.join(name), &view)?;
                    stills += 1;
                }
                let p = camera.position();
                let name = still.unwrap_or_default();
                // Writing to a String does not fail.
                let _ = writeln!(table, "{i},{:.6},{:.6},{:.6},{name}", p.x, p.y, p.z);
                bar.inc(1);
            }
            Ok::<_, anyhow::Error>(())
        })?;
        let bytes = video.context("no frame")?.finish()?;
        write_atomic(self.out.join(format!("{id}.csv")), |f| f.write_all(table.as_bytes()))?;
        let notes = self.notes(&[], opened.generated);
        let place = format!("{} of {}", case.scene, opened.name);
        let mut text = format!("# {id}: {}\n\n{frames} frames of {place}.\n\n", self.table.title);
        notes.iter().for_each(|note| text += &format!("* {note}\n"));
        write_atomic(self.out.join(format!("{id}.md")), |f| f.write_all(text.as_bytes()))?;
        answer.line(text.trim_end());
        answer.line(format!(
            "video.webp ({:.1} MB), {stills} stills, {id}.csv, {id}.md in {}\n",
            bytes as f64 / 1e6,
            self.out.display()
        ));
        opened.benchmark.notes().iter().for_each(|n| print_line(format!("note: {n}")));
        Ok(json!({
            "frames": frames, "pictures": stills, "generated": opened.generated, "notes": notes,
            "bytes": bytes,
        }))
    }
}

/// The views of all scenes from one camera, side by side.
fn beside(scenes: &[Reconstruction], camera: &Camera) -> Rgb {
    let k = camera.intrinsics();
    let mut joined = Rgb::black(scenes.len() * k.width, k.height);
    for (i, scene) in scenes.iter().enumerate() {
        let picture: Picture = scene.render(camera);
        paste(&mut joined, &Rgb::from(&picture), (i * k.width, 0));
    }
    joined
}
