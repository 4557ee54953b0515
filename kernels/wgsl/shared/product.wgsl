// A tile of a matrix product: a workgroup of 256 threads computes 64 x 64 sums in steps of 16 terms,
// a thread 4 x 4 of them.

const SIDE: u32 = 64u;
const STEP: u32 = 16u;

// [STEP, SIDE / 4]: terms of four rows, and of four columns.
var<workgroup> rows: array<vec4<f32>, 256>;
var<workgroup> columns: array<vec4<f32>, 256>;

// Adds the products of a step, whose terms all threads have written, to a thread's 4 x 4 sums.
fn add_step(sums: ptr<function, array<vec4<f32>, 4>>, thread: u32) {
    workgroupBarrier();
    for (var k = 0u; k < STEP; k++) {
        let row = rows[k * SIDE / 4u + thread / 16u];
        let column = columns[k * SIDE / 4u + thread % 16u];
        (*sums)[0] += row.x * column;
        (*sums)[1] += row.y * column;
        (*sums)[2] += row.z * column;
        (*sums)[3] += row.w * column;
    }
    workgroupBarrier();
}
