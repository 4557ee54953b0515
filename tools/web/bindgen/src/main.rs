//! Replaces the declarations of wasm-bindgen in a module: `subsplat-web-bindgen INPUT.wasm FOLDER`
//! writes `subsplat_bg.wasm` and its imports, `subsplat_bg.js`.

use std::error::Error;
use wasm_bindgen_cli_support::Bindgen;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [input, folder] = arguments.as_slice() else {
        return Err(format!("expected INPUT.wasm FOLDER, got {arguments:?}").into());
    };
    Bindgen::new()
        .input_path(input)
        .out_name("subsplat")
        .bundler(true)?
        .typescript(false)
        .remove_name_section(true)
        .remove_producers_section(true)
        .generate(folder)?;
    Ok(())
}
