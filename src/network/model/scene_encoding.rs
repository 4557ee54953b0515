//! One scene after the backbone, on the executor that computed it.
//!
//! On a GPU the backbone's outputs, the primaries and the children stay in device memory until the
//! host needs them: [`SceneEncoding::render`] reads one picture, [`SceneEncoding::children`] the
//! Gaussians. A failure of the device repeats the scene on the CPU.
//!
//! A chunk of children is a part of the rasterizer's scene, without a copy. `SceneEncoding::render` reads back
//! the picture and the 48 bytes that hold the frame's number of pairs; `Gpu::read_backs` counts, and a
//! test compares. `subsplat run` writes the Gaussians. It reads them, with depths and SH, in one wait; with a limit on
//! their number it reads the primaries before. Gaussians that are not finite are errors there. `render`
//! on a GPU does not draw them, because a check would be one more read-back.
//!
//! Repeating single calls after a failure, or the trunk alone, would need copies of arrays in host memory.

use super::primaries::primaries;
use super::subsplat::{SceneOutput, SubSplat, in_pool};
use super::trace::{Checkpoint, Trace};
use super::trunk::DeviceParents;
use super::trunk::{MixedChildren, Trunk};
use super::{BackboneOutput, Primaries, Views};
use crate::network::ops::{Array, TapeArray};
use crate::scene::splats::Splats;
use candle_core::{DType, Device, Result, Tensor, bail};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{RasterOptions, SPLAT_STRIDE};

/// Outputs of the backbone for one scene.
pub struct SceneFeatures {
    views: Views,
    output: Output,
}

/// Outputs of the backbone for one scene, and its primaries.
pub struct SceneEncoding {
    views: Views,
    place: Place,
    /// Rows `[N, 11]` that replace the primaries' own ones ([`SceneEncoding::with_parents`]).
    moved: Option<Tensor>,
}

enum Output {
    Host(BackboneOutput),
    Device(BackboneOutput<TapeArray>),
}

enum Place {
    Host(BackboneOutput, Primaries),
    Device(Box<DeviceParents>),
}

impl SubSplat {
    /// Runs the backbone on the one scene in `views`, with `checkpoint` after each of
    /// [`SubSplat::encode_steps`]. A GPU has executed all work at the return, and keeps the results.
    ///
    /// # Errors
    /// More than one scene; those of [`SubSplat::encode_with`].
    pub fn encode_scene(&self, views: &Views, checkpoint: Checkpoint<'_>) -> Result<SceneFeatures> {
        self.features(views, checkpoint, true)
    }

    /// [`SubSplat::encode_scene`]; without `waits` a GPU may still work.
    pub(super) fn features(
        &self,
        views: &Views,
        checkpoint: Checkpoint<'_>,
        waits: bool,
    ) -> Result<SceneFeatures> {
        self.check_input(views)?;
        if views.scenes() != 1 {
            bail!("encoding: expected one scene, got {}", views.scenes());
        }
        if let Some(result) = self.trunk().on_device(|executor| {
            let images = executor.upload(&views.images)?;
            let mut trace = Trace::with_checkpoint(checkpoint);
            let levels = |level| self.trunk().reads(level);
            let output = self.encode_on(views, &images, &levels, &mut trace)?;
            // Inference needs no tape.
            let output = output.map(|array| Ok(array.detach()))?;
            if waits {
                executor.finish()?;
            }
            Ok(SceneFeatures { views: views.clone(), output: Output::Device(output) })
        }) {
            return result;
        }
        // The CPU has nothing to wait for.
        let _ = waits;
        self.host_features(views, checkpoint)
    }

    /// Runs the backbone on the CPU.
    fn host_features(&self, views: &Views, checkpoint: Checkpoint<'_>) -> Result<SceneFeatures> {
        let mut trace = Trace::with_checkpoint(checkpoint);
        let levels = |level| self.trunk().reads(level);
        let output = self.encode_on(views, &views.images, &levels, &mut trace)?;
        Ok(SceneFeatures { views: views.clone(), output: Output::Host(output) })
    }

    /// Places the primaries in world frame.
    ///
    /// # Errors
    /// Shapes of the outputs that do not fit the views.
    pub fn place(&self, features: SceneFeatures) -> Result<SceneEncoding> {
        let SceneFeatures { views, output } = features;
        let settings = self.config().primaries();
        let output = match output {
            Output::Host(output) => output,
            Output::Device(output) => {
                let sh_input = self.config().embed.sh;
                let placed = self
                    .trunk()
                    .on_device(|_| DeviceParents::new(output, &views, settings, sh_input));
                return match placed {
                    Some(parents) => {
                        let place = Place::Device(Box::new(parents?));
                        Ok(SceneEncoding { views, place, moved: None })
                    }
                    None => self.encoding_on_host(&views),
                };
            }
        };
        let parents = primaries(&output, &views, settings, &mut Trace::off())?;
        // The primaries have all of it: 22 numbers of each pixel.
        let raw = Tensor::zeros(0, DType::F32, &Device::Cpu)?;
        let output = BackboneOutput { raw, ..output };
        Ok(SceneEncoding::new(views, output, parents))
    }

    /// Computes backbone and primaries on the CPU, after a failure of the device.
    fn encoding_on_host(&self, views: &Views) -> Result<SceneEncoding> {
        self.place(in_pool(|| self.host_features(views, &|| Ok(())))?)
    }
}

impl SceneEncoding {
    /// Returns results in host memory.
    pub fn new(views: Views, output: BackboneOutput, primaries: Primaries) -> Self {
        Self { views, place: Place::Host(output, primaries), moved: None }
    }

    /// Replaces means, rotations, scales and opacities of the primaries by those of `parents`, which are
    /// [`SceneEncoding::parents`] after an optimisation. Their colours stay those of the network.
    ///
    /// # Errors
    /// Another number of parents; errors of the device.
    pub fn with_parents(self, network: &SubSplat, parents: &Splats) -> Result<Self> {
        let count = self.per_view() * self.views.views();
        if parents.len() != count {
            bail!("parents: expected {count}, got {}", parents.len());
        }
        let rows = Tensor::from_slice(&parents.rows, (count, SPLAT_STRIDE), &Device::Cpu)?;
        self.moved(network, rows)
    }

    /// Replaces the primaries' rows.
    fn moved(self, network: &SubSplat, rows: Tensor) -> Result<Self> {
        let Self { views, place, .. } = self;
        let place = match place {
            Place::Host(output, primaries) => Place::Host(output, primaries.with_rows(&rows)?),
            Place::Device(parents) => {
                let replaced =
                    network.trunk().on_device(|executor| parents.with_rows(executor, &rows));
                match replaced {
                    Some(parents) => Place::Device(Box::new(parents?)),
                    None => return network.encoding_on_host(&views)?.moved(network, rows),
                }
            }
        };
        Ok(Self { views, place, moved: Some(rows) })
    }

    /// The same encoding, computed by the CPU after a failure of the device.
    fn on_host(&self, network: &SubSplat) -> Result<Self> {
        let host = network.encoding_on_host(&self.views)?;
        match &self.moved {
            Some(rows) => host.moved(network, rows.clone()),
            None => Ok(host),
        }
    }

    /// Returns the number of primaries of a view.
    pub fn per_view(&self) -> usize {
        match &self.place {
            Place::Host(_, primaries) => primaries.per_view,
            Place::Device(parents) => parents.per_view,
        }
    }

    /// Returns the number of steps of [`SceneEncoding::children`] with `trunk`.
    pub fn steps(&self, trunk: &Trunk) -> usize {
        trunk.steps_of(self.per_view() * self.views.views(), self.per_view())
    }

    /// Returns the primaries as Gaussians in host memory.
    ///
    /// # Errors
    /// A number that is not finite.
    pub fn parents(&self, network: &SubSplat) -> Result<Splats> {
        match &self.place {
            Place::Host(_, primaries) => {
                network.trunk().parents(&self.views, primaries)?.to_splats()
            }
            Place::Device(parents) => {
                match network.trunk().on_device(|executor| parents.to_host(executor)) {
                    Some(parents) => parents,
                    None => self.on_host(network)?.parents(network),
                }
            }
        }
    }

    /// Computes the children, with `checkpoint` after each of [`SceneEncoding::steps`], on any thread. A
    /// GPU has executed a step at its checkpoint.
    ///
    /// # Errors
    /// Those of [`Trunk::forward_with`].
    pub fn children(&self, network: &SubSplat, checkpoint: Checkpoint<'_>) -> Result<SceneOutput> {
        let (output, primaries) = match &self.place {
            Place::Host(output, primaries) => (output, primaries),
            Place::Device(parents) => {
                let made = network.trunk().on_device(|executor| {
                    let trunk = network.trunk();
                    let steps = (checkpoint, true);
                    let children = trunk.device_children(&self.views, parents, steps)?;
                    let (children, depths) = children.to_host(executor, &[&parents.depths])?;
                    let finite = |t: &Tensor| -> Result<bool> {
                        Ok(t.flatten_all()?.to_vec1::<f32>()?.iter().all(|v| v.is_finite()))
                    };
                    if !finite(&children.rows)? || !finite(&children.gain)? {
                        // The checked form names the parent.
                        trunk.check_device_children(&self.views, parents)?;
                    }
                    let depths = distances(depths.first())?;
                    Ok(SceneOutput { children, depths })
                });
                return match made {
                    Some(made) => made,
                    None => self.on_host(network)?.children(network, checkpoint),
                };
            }
        };
        let trunk = network.trunk();
        let children = trunk.forward_with(&self.views, output, primaries, checkpoint)?;
        Ok(SceneOutput { children, depths: distances(Some(&output.depths))? })
    }

    /// Computes children of which parent i, one of `parents`, has `counts[i]`, and the distances of
    /// [`SceneOutput::depths`].
    ///
    /// # Errors
    /// Those of [`Trunk::forward_mixed`].
    pub fn mixed(
        &self,
        network: &SubSplat,
        parents: &Splats,
        counts: &[u8],
        checkpoint: Checkpoint<'_>,
    ) -> Result<(MixedChildren, Vec<Vec<f32>>)> {
        let trunk = network.trunk();
        let (output, primaries) = match &self.place {
            Place::Host(output, primaries) => (output, primaries),
            Place::Device(device) => {
                let made = trunk.on_device(|executor| {
                    let own = (&**device, parents);
                    let mixed = trunk.device_mixed(&self.views, own, counts, checkpoint)?;
                    let depths = executor.read(&[&device.depths])?;
                    Ok((mixed, distances(depths.first())?))
                });
                return match made {
                    Some(made) => made,
                    None => self.on_host(network)?.mixed(network, parents, counts, checkpoint),
                };
            }
        };
        let own = (primaries, parents);
        let mixed = trunk.host_mixed(&self.views, output, own, counts, checkpoint)?;
        Ok((mixed, distances(Some(&output.depths))?))
    }

    /// Renders the children from `camera`: `[5, H, W]` ([`Trunk::render`]). A GPU reads nothing back but
    /// the picture and its number of (splat, tile) pairs, and does not draw Gaussians that are not finite.
    ///
    /// # Errors
    /// Those of [`Trunk::render`]; on a GPU no error names a Gaussian that is not finite.
    pub fn render(
        &self,
        network: &SubSplat,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Tensor> {
        let trunk = network.trunk();
        match &self.place {
            Place::Host(output, primaries) => {
                in_pool(|| trunk.render(&self.views, output, primaries, camera, options))
            }
            Place::Device(parents) => {
                let made = trunk.on_device(|executor| {
                    let steps: (Checkpoint<'_>, bool) = (&|| Ok(()), false);
                    let children = trunk.device_children(&self.views, parents, steps)?;
                    children.render(executor, camera, options)
                });
                match made {
                    Some(picture) => picture,
                    None => self.on_host(network)?.render(network, camera, options),
                }
            }
        }
    }
}

/// Distance of each pixel's first Gaussian, `[V][H·W]`, of `[1, V, H·W, G]`.
fn distances(depths: Option<&Tensor>) -> Result<Vec<Vec<f32>>> {
    match depths {
        Some(depths) => depths.narrow(3, 0, 1)?.squeeze(3)?.squeeze(0)?.to_vec2(),
        None => bail!("depths: expected a tensor, got none"),
    }
}
