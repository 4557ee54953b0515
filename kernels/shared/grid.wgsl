// Numbering of workgroups that one dimension of a dispatch cannot hold
// (src/gpu/commands.rs spreads them over x and y).

fn workgroup_number(id: vec3<u32>, groups: vec3<u32>) -> u32 {
    return id.y * groups.x + id.x;
}
