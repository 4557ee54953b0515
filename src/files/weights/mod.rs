//! Weights: safetensors, and checkpoints of PyTorch.

pub mod tensors;
pub mod torch;
