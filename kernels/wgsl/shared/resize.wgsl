// Bilinear resize with corner pixels on corner pixels: sizes, and places on an axis.

@group(0) @binding(0) var<uniform> call: ResizeUniform;

// A place on an axis: the index before it, and the share of the next.
struct Tap {
    index: u32,
    share: f32,
}

// Returns the place of output i of `to` on an axis of `size`.
fn tap(i: u32, size: u32, to: u32) -> Tap {
    if size < 2u || to < 2u {
        return Tap(0u, 0.0);
    }
    let place = i * (size - 1u);
    let index = min(place / (to - 1u), size - 2u);
    return Tap(index, f32(place - index * (to - 1u)) / f32(to - 1u));
}
