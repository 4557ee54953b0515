// Uniform of opacity redistribution (src/cpu/redistribute.rs).

struct RedistributeUniform {
    parents: u32,
    children: u32,
    rule: u32,
    pad: u32,
}
