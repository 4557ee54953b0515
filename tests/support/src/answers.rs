//! Checks of the objects that the programs print with `--json`.

use serde_json::Value;

/// The object has these keys.
#[track_caller]
pub fn keys(value: &Value, expected: &[&str]) {
    let object = value.as_object().unwrap();
    for key in expected {
        assert!(object.contains_key(*key), "no `{key}` in {value}");
    }
}

/// Stages add up to the total, which is the only double count.
#[track_caller]
pub fn seconds(report: &Value, stages: &[&str]) {
    keys(&report["seconds"], stages);
    let object = report["seconds"].as_object().unwrap();
    let total = object["total"].as_f64().unwrap();
    let sum: f64 =
        object.iter().filter(|(k, _)| *k != "total").map(|(_, v)| v.as_f64().unwrap()).sum();
    // Each is rounded to a millisecond.
    assert!(sum <= total + 0.02, "{object:?}");
    let peak = report["peak_memory_bytes"].as_u64();
    assert!(cfg!(not(target_os = "linux")) || peak > Some(1 << 20), "{peak:?}");
}
