// Returns whether v is neither infinite nor NaN. The test uses the bits, because compilers may
// assume that neither occurs.
fn finite(v: f32) -> bool {
    return (bitcast<u32>(v) & 0x7f800000u) != 0x7f800000u;
}
