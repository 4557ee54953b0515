//! Adam and AdamW over all parameters in one contiguous array: one pass per step for clipping,
//! moments, weights and their moving average.
//!
//! Sources: Kingma and Ba 2015, algorithm 1; Loshchilov and Hutter 2019. On a GPU
//! ([`Optimizer::set_device`]) the same step runs over arrays in device memory. Host memory has copies of
//! them after each step, so that a checkpoint, a moving average and a lost device need no others.

use candle_core::backprop::GradStore;
use candle_core::{Device, Result, Tensor, Var, bail};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::hash::Hasher;
use std::ops::Range;
use std::sync::Arc;
use subsplat::network::ops::{Backend, DeviceAdam, Executor, ParameterStep, SharedStep};
use subsplat_kernels::cpu::adam::AdamStep;

/// Options of the optimizer. Defaults: PyTorch's AdamW, clipping at 1, moving average 0.997.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Decay of the first and of the second moment.
    pub betas: [f64; 2],
    /// Term added to the root of the second moment.
    pub epsilon: f64,
    /// Decoupled decay of weights with two or more axes (AdamW); 0 is Adam.
    pub weight_decay: f64,
    /// Largest norm of all gradients together; 0 disables clipping.
    pub clip: f64,
    /// Decay of the moving average of the weights, which is the shipped result; 0 keeps the weights
    /// themselves. The decay rises to this value as (1 + step)/(10 + step).
    pub average: f64,
    /// Factor on the learning rate of the backbone.
    pub backbone_rate: f64,
    /// Keeps the backbone constant. No gradient flows through it, and its depth losses are omitted.
    pub freeze_backbone: bool,
    /// Ends of the names of the parameters that are trained; the others stay constant. Empty: all.
    pub only: Vec<String>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            betas: [0.9, 0.999],
            epsilon: 1e-8,
            weight_decay: 0.01,
            clip: 1.0,
            average: 0.997,
            backbone_rate: 1.0,
            freeze_backbone: false,
            only: Vec::new(),
        }
    }
}

/// One parameter and its range in the array.
#[derive(Clone, Debug)]
struct Slot {
    name: String,
    var: Var,
    span: Range<usize>,
    decays: bool,
    backbone: bool,
    frozen: bool,
}

/// All parameters of a model, in the order of their names, and the optimizer's state.
#[derive(Debug)]
pub struct Optimizer {
    settings: Settings,
    slots: Vec<Slot>,
    values: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
    average: Vec<f32>,
    /// Number of updates of each parameter, for its bias correction. A parameter without a gradient
    /// is not updated.
    updates: Vec<u64>,
    /// The same state in device memory.
    device: Option<OnDevice>,
}

/// The state on a GPU.
#[derive(Debug)]
struct OnDevice {
    executor: Arc<Executor>,
    backend: Backend,
    adam: DeviceAdam,
}

/// Sum of the gradients of several backward passes.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// Summed gradients of all parameters.
    sum: Vec<f32>,
    /// True for each parameter that received a gradient.
    touched: Vec<bool>,
}

impl Gradients {
    /// Returns the norm of all gradients together.
    pub fn norm(&self) -> f64 {
        let sums: Vec<f64> = self
            .sum
            .par_chunks(4096)
            .map(|c| c.iter().map(|g| f64::from(*g) * f64::from(*g)).sum())
            .collect();
        sums.iter().sum::<f64>().sqrt()
    }

    /// Adds another sum over the same parameters.
    pub fn add(&mut self, other: &Self) {
        self.sum.par_iter_mut().zip(&other.sum).for_each(|(a, b)| *a += b);
        self.touched.iter_mut().zip(&other.touched).for_each(|(a, b)| *a |= b);
    }

    /// Returns the summed gradients of all parameters, and which parameters received one.
    pub(super) fn parts(&self) -> (&[f32], &[bool]) {
        (&self.sum, &self.touched)
    }

    /// The gradients with these [`Gradients::parts`]; `None` where their lengths are not those of
    /// `optimizer`.
    pub(super) fn from_parts(
        sum: Vec<f32>,
        touched: Vec<bool>,
        optimizer: &Optimizer,
    ) -> Option<Self> {
        let fits = sum.len() == optimizer.values.len() && touched.len() == optimizer.slots.len();
        fits.then_some(Self { sum, touched })
    }

    /// Sets all gradients to zero.
    pub fn clear(&mut self) {
        self.sum.fill(0.0);
        self.touched.fill(false);
    }
}

/// The optimizer's state by tensor name, for a checkpoint.
pub type State = BTreeMap<String, Tensor>;

/// Prefixes of the state's tensors.
const ROWS: [&str; 4] = ["weights/", "first/", "second/", "average/"];
/// Tensor name of the numbers of updates, exact in f32 up to 2²⁴.
const UPDATES: &str = "updates";

impl Optimizer {
    /// Creates an optimizer of `variables`, by name. Backbone parameters are those whose names do
    /// not start with `subsplat.`.
    ///
    /// # Errors
    /// A variable that is not f32; an entry of [`Settings::only`] that names none.
    pub fn new(settings: Settings, variables: BTreeMap<String, Var>) -> Result<Self> {
        let only = &settings.only;
        if let Some(end) = only.iter().find(|end| !variables.keys().any(|n| n.ends_with(*end))) {
            bail!(
                "optimizer.only: expected ends of parameters' names, got `{end}`, which ends none"
            );
        }
        let (mut slots, mut values) = (Vec::new(), Vec::new());
        for (name, var) in variables {
            let start = values.len();
            values.extend(var.flatten_all()?.to_vec1::<f32>()?);
            let backbone = !name.starts_with(subsplat::network::model::weights::SUBSPLAT_PREFIX);
            let named = only.is_empty() || only.iter().any(|end| name.ends_with(end));
            slots.push(Slot {
                decays: var.rank() >= 2,
                backbone,
                frozen: (backbone && settings.freeze_backbone) || !named,
                span: start..values.len(),
                name,
                var,
            });
        }
        let n = values.len();
        Ok(Self {
            settings,
            updates: vec![0; slots.len()],
            slots,
            first: vec![0.0; n],
            second: vec![0.0; n],
            average: values.clone(),
            values,
            device: None,
        })
    }

    /// Computes norms and steps on the GPU of `executor`, which reads the parameters from there;
    /// `backend` learns of its failure, after which the CPU goes on.
    ///
    /// # Errors
    /// Those of the parameters' tensors.
    pub fn set_device(&mut self, executor: &Arc<Executor>, backend: &Backend) -> Result<()> {
        self.device = None;
        let moved: Option<Result<DeviceAdam>> = executor.attempt(backend, || {
            let spans = self.slots.iter().map(|slot| slot.span.clone()).collect();
            let state = [&self.values, &self.first, &self.second, &self.average];
            let adam = DeviceAdam::new(executor, spans, state.map(Vec::as_slice))?;
            let part = |(i, slot): (usize, &Slot)| -> Result<_> {
                Ok((slot.var.as_tensor().clone(), adam.value(i, slot.var.dims())?))
            };
            let parts = self.slots.iter().enumerate().map(part).collect::<Result<Vec<_>>>()?;
            executor.keep_trained(&parts)?;
            Ok(adam)
        });
        if let Some(adam) = moved {
            let (executor, backend) = (executor.clone(), backend.clone());
            self.device = Some(OnDevice { executor, backend, adam: adam? });
        }
        Ok(())
    }

    /// Runs `f` on the GPU; `None` where there is none or it failed, and the CPU goes on for good.
    fn on_device<R>(&mut self, f: impl FnOnce(&DeviceAdam) -> Result<R>) -> Result<Option<R>> {
        let Some(OnDevice { executor, backend, adam }) = &self.device else { return Ok(None) };
        match executor.attempt(backend, || f(adam)) {
            Some(result) => result.map(Some),
            None => {
                // The values on the device may be those of no step.
                executor.keep_trained(&[])?;
                self.device = None;
                Ok(None)
            }
        }
    }

    /// Returns whether a GPU has the state.
    pub fn is_on_device(&self) -> bool {
        self.device.is_some()
    }

    /// Returns the norm of all gradients together, computed where the state is.
    ///
    /// # Errors
    /// Gradients of other parameters.
    pub fn norm(&mut self, gradients: &Gradients) -> Result<f64> {
        if let Some(norm) = self.on_device(|adam| adam.norm(&gradients.sum))? {
            return Ok(norm);
        }
        Ok(gradients.norm())
    }

    /// Returns the number of parameters.
    pub fn parameters(&self) -> usize {
        self.values.len()
    }

    /// Adds the bits of all parameters to a hash.
    pub(super) fn hash_values(&self, hasher: &mut impl Hasher) {
        self.values.iter().for_each(|v| hasher.write_u32(v.to_bits()));
    }

    /// Returns zero gradients.
    pub fn gradients(&self) -> Gradients {
        Gradients { sum: vec![0.0; self.values.len()], touched: vec![false; self.slots.len()] }
    }

    /// Adds the gradients of a backward pass.
    ///
    /// # Errors
    /// A gradient that is not f32.
    pub fn collect(&self, store: &GradStore, gradients: &mut Gradients) -> Result<()> {
        for (i, slot) in self.slots.iter().enumerate() {
            if slot.frozen {
                continue;
            }
            let Some(gradient) = store.get(&slot.var) else { continue };
            let found = gradient.flatten_all()?.to_vec1::<f32>()?;
            let sum = &mut gradients.sum[slot.span.clone()];
            if found.len() != sum.len() {
                bail!("gradient of `{}`: expected {} elements", slot.name, sum.len());
            }
            sum.iter_mut().zip(&found).for_each(|(s, g)| *s += g);
            gradients.touched[i] = true;
        }
        Ok(())
    }

    /// Takes step number `step` with learning rate `rate`. `norm` is the norm of `gradients`, which
    /// the caller has already computed.
    ///
    /// # Errors
    /// A tensor operation that fails.
    pub fn step(&mut self, gradients: &Gradients, norm: f64, rate: f64, step: u64) -> Result<()> {
        for (updates, touched) in self.updates.iter_mut().zip(&gradients.touched) {
            *updates += u64::from(*touched);
        }
        let steps: Vec<Option<AdamStep>> = (0..self.slots.len())
            .map(|i| gradients.touched[i].then(|| self.constants(i, norm, rate, step)))
            .collect();
        if !self.step_on_device(gradients, &steps)? {
            for (slot, update) in self.slots.iter().zip(&steps) {
                let (Some(update), span) = (update, slot.span.clone()) else { continue };
                update.run(
                    &gradients.sum[span.clone()],
                    &mut self.values[span.clone()],
                    [&mut self.first[span.clone()], &mut self.second[span.clone()]],
                    &mut self.average[span],
                );
            }
        }
        for (slot, _) in self.slots.iter().zip(&steps).filter(|(_, update)| update.is_some()) {
            let span = slot.span.clone();
            slot.var.set(&Tensor::from_slice(
                &self.values[span],
                slot.var.shape(),
                &Device::Cpu,
            )?)?;
        }
        Ok(())
    }

    /// Constants of step number `step` for parameter `i`.
    fn constants(&self, i: usize, norm: f64, rate: f64, step: u64) -> AdamStep {
        let (s, slot) = (&self.settings, &self.slots[i]);
        let clip = if s.clip > 0.0 && norm > s.clip { s.clip / norm } else { 1.0 };
        let decay = s.average.min((1.0 + step as f64) / (10.0 + step as f64));
        let decay = if s.average > 0.0 { decay } else { 0.0 };
        let t = self.updates[i] as i32;
        let rate = if slot.backbone { rate * s.backbone_rate } else { rate };
        AdamStep {
            clip: clip as f32,
            betas: s.betas.map(|b| b as f32),
            // Both bias corrections are folded into the rate and the scale of ε.
            rate: (rate / (1.0 - s.betas[0].powi(t))) as f32,
            root: (1.0 / (1.0 - s.betas[1].powi(t)).sqrt()) as f32,
            epsilon: s.epsilon as f32,
            keep: if slot.decays { (1.0 - rate * s.weight_decay) as f32 } else { 1.0 },
            average: decay as f32,
        }
    }

    /// Takes a step on the GPU and copies its results; false where the CPU must take it.
    fn step_on_device(
        &mut self,
        gradients: &Gradients,
        steps: &[Option<AdamStep>],
    ) -> Result<bool> {
        let Some(shared) = steps.iter().flatten().next() else { return Ok(true) };
        let AdamStep { clip, betas, epsilon, average, .. } = *shared;
        let shared = SharedStep { clip, betas, epsilon, average };
        let own = |step: &AdamStep| {
            let AdamStep { rate, root, keep, .. } = *step;
            ParameterStep { rate, root, keep }
        };
        let own: Vec<_> = steps.iter().map(|step| step.as_ref().map(own)).collect();
        let Some(state) = self.on_device(|adam| adam.step(&gradients.sum, shared, &own))? else {
            return Ok(false);
        };
        [self.values, self.first, self.second, self.average] = state;
        Ok(true)
    }

    /// Returns the moving average of the weights, by the model's names.
    ///
    /// # Errors
    /// A tensor operation that fails.
    pub fn averaged(&self) -> Result<BTreeMap<String, Tensor>> {
        self.named("", &self.average)
    }

    /// Splits an array into tensors by name.
    fn named(&self, prefix: &str, row: &[f32]) -> Result<BTreeMap<String, Tensor>> {
        let tensor = |s: &Slot| -> Result<(String, Tensor)> {
            let t = Tensor::from_slice(&row[s.span.clone()], s.var.shape(), &Device::Cpu)?;
            Ok((format!("{prefix}{}", s.name), t))
        };
        self.slots.iter().map(tensor).collect()
    }

    /// Returns the complete state, from which the next step follows.
    ///
    /// # Errors
    /// A tensor operation that fails.
    pub fn state(&self) -> Result<State> {
        let mut state = State::new();
        for (prefix, row) in
            ROWS.into_iter().zip([&self.values, &self.first, &self.second, &self.average])
        {
            state.extend(self.named(prefix, row)?);
        }
        let updates: Vec<f32> = self.updates.iter().map(|u| *u as f32).collect();
        state.insert(UPDATES.into(), Tensor::from_vec(updates, self.slots.len(), &Device::Cpu)?);
        Ok(state)
    }

    /// Restores the result of [`Optimizer::state`].
    ///
    /// # Errors
    /// A tensor that is missing, has another shape, or belongs to no parameter.
    pub fn restore(&mut self, mut state: State) -> Result<()> {
        for slot in &self.slots {
            let rows = [&mut self.values, &mut self.first, &mut self.second, &mut self.average];
            for (prefix, row) in ROWS.into_iter().zip(rows) {
                let name = format!("{prefix}{}", slot.name);
                let tensor = take_tensor(&mut state, &name, slot.var.dims())?;
                row[slot.span.clone()].copy_from_slice(&tensor.flatten_all()?.to_vec1::<f32>()?);
            }
            let value = &self.values[slot.span.clone()];
            slot.var.set(&Tensor::from_slice(value, slot.var.shape(), &Device::Cpu)?)?;
        }
        let updates = take_tensor(&mut state, UPDATES, &[self.slots.len()])?.to_vec1::<f32>()?;
        self.updates = updates.into_iter().map(|u| u as u64).collect();
        if let Some(OnDevice { executor, backend, .. }) = self.device.take() {
            self.set_device(&executor, &backend)?;
        }
        match state.keys().next() {
            Some(name) => bail!("checkpoint: tensor `{name}` does not belong to this model"),
            None => Ok(()),
        }
    }
}

/// Removes a tensor of shape `dims` from the state.
fn take_tensor(state: &mut State, name: &str, dims: &[usize]) -> Result<Tensor> {
    match state.remove(name) {
        Some(t) if t.dims() == dims => Ok(t),
        Some(t) => bail!("checkpoint tensor `{name}`: expected {dims:?}, got {:?}", t.dims()),
        None => bail!("checkpoint: expected a tensor `{name}`, got none"),
    }
}
