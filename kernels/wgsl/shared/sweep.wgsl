// Parameters of the plane sweep. CPU version: cpu/plane_sweep/mod.rs.

@group(0) @binding(0) var<uniform> call: PlaneSweepUniform;
