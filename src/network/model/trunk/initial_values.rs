//! Initial values of the trunk's parameters that `candle_nn::Init` cannot express.

use crate::network::model::aggregation::ring;
use candle_core::{Result, Tensor, bail};
use candle_nn::VarMap;

/// Returns the initial value of a tensor that `candle_nn::Init` cannot express, `None` for
/// every other tensor.
///
/// W_k starts as the identity (cut or padded with zeros if it is not square), the `cat`
/// layer as f + o, learned map offsets as a ring. `name` is the full tensor name, such as
/// `subsplat.agg.g0.wk.0.weight`.
pub fn initial_value(name: &str, shape: &[usize]) -> Option<Vec<f32>> {
    let parts: Vec<&str> = name.rsplit('.').collect();
    let in_stage = |depth: usize| parts.get(depth + 1) == Some(&"agg");
    match (parts.as_slice(), shape) {
        (["weight", _, "wk", ..], &[rows, columns]) if in_stage(3) => {
            Some(eye(rows, columns, columns))
        }
        (["weight", "cat", ..], &[rows, columns]) if in_stage(2) => Some(eye(rows, columns, rows)),
        (["bias", "offsets", ..], &[len]) if in_stage(2) => Some(ring(len)),
        _ => None,
    }
}

/// Row-major matrix with 1 where the column modulo `period` equals the row.
fn eye(rows: usize, columns: usize, period: usize) -> Vec<f32> {
    let one = |i: usize| (i % columns.max(1)) % period.max(1) == i / columns.max(1);
    (0..rows * columns).map(|i| if one(i) { 1.0 } else { 0.0 }).collect()
}

/// Sets every variable for which [`initial_value`] has a value. Call it once after a new
/// model is built from a `VarMap`.
///
/// # Errors
/// Those of candle's assignment.
pub fn set_initial_values(variables: &VarMap) -> Result<()> {
    let Ok(data) = variables.data().lock() else { bail!("variables: lock poisoned") };
    for (name, var) in data.iter() {
        if let Some(value) = initial_value(name, var.dims()) {
            let value = Tensor::from_vec(value, var.dims(), var.device())?;
            var.set(&value.to_dtype(var.dtype())?)?;
        }
    }
    Ok(())
}
