// What the kernels of a parent's opacity are told (src/cpu/redistribute.rs).

struct RedistributeUniform {
    parents: u32,
    children: u32,
    rule: u32,
    pad: u32,
}
