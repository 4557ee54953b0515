//! The modules against goldens of the ONNX witness.

mod mvsplat_modules;
mod subsplat_modules;
