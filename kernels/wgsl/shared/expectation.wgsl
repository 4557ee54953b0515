// Softmax over candidates: the mode of a pixel, and sums of weights.

@group(0) @binding(0) var<uniform> call: ExpectationUniform;
// [pictures, candidates, pixels].
@group(0) @binding(1) var<storage, read> logits: array<f32>;

// Largest logit, its candidate, and sums of weights and of weights times the distance from the mode:
// of all candidates, of the window.
struct Mode {
    most: f32,
    candidate: u32,
    all: vec2<f32>,
    near: vec2<f32>,
}

// Returns the mode and the sums of the pixel whose first logit is `base`.
fn mode_of(base: u32) -> Mode {
    var most = logits[base];
    var mode = 0u;
    for (var k = 1u; k < call.candidates; k++) {
        let x = logits[base + k * call.pixels];
        if x > most {
            most = x;
            mode = k;
        }
    }
    var all = vec2<f32>();
    var near = vec2<f32>();
    for (var k = 0u; k < call.candidates; k++) {
        let away = i32(k) - i32(mode);
        let weight = exp(logits[base + k * call.pixels] - most);
        let term = weight * vec2<f32>(1.0, f32(away));
        all += term;
        if abs(away) <= i32(call.window) {
            near += term;
        }
    }
    return Mode(most, mode, all, near);
}
