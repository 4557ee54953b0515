//! PyTorch files, good and hostile.

mod hostile_torch;
mod torch_files;
