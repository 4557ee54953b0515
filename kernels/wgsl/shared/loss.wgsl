// Pixels of a picture and of its truth in the loss of a photograph (kernels/src/gpu/finish/loss.rs). A kernel
// that uses this has `call`, a LossUniform, and the bindings `picture` [5, H, W] (R, G, B, alpha,
// sum of w·z) and `truth` [H, W], R, G, B and the mask as bytes.

// Returns the truth of pixel p, and 1 where the mask keeps it, else 0.
fn truth_of(p: u32) -> vec4<f32> {
    return unpack4x8unorm(truth[p]);
}

// Returns R, G and B of pixel p of the picture.
fn picture_of(p: u32) -> vec3<f32> {
    let pixels = call.width * call.height;
    return vec3<f32>(picture[p], picture[pixels + p], picture[2u * pixels + p]);
}

// Returns the weight of pixel p, 0 to 1. `kept` is that of the mask. Where only covered pixels count, it
// rises linearly from 0 at the least coverage to 1.
fn weight_of(p: u32, kept: f32) -> f32 {
    if call.covered == 0u {
        return kept;
    }
    let alpha = picture[3u * call.width * call.height + p];
    return kept * clamp((alpha - call.coverage_min) / (1.0 - call.coverage_min), 0.0, 1.0);
}

// Returns what a pixel is compared with: `own`, the rendered value, where it has no weight.
fn seen_of(own: f32, truth: f32, weight: f32) -> f32 {
    return select(own + weight * (truth - own), truth, weight == 1.0);
}

fn tap(k: u32) -> f32 {
    return call.taps[k / 4u][k % 4u];
}
