// Index of a workgroup. Counts that exceed one dimension of a dispatch are spread over x and y
// (gpu/commands.rs).

fn workgroup_number(id: vec3<u32>, groups: vec3<u32>) -> u32 {
    return id.y * groups.x + id.x;
}
