// Backward pass of a normalisation: a workgroup's part of a channel of one picture.

@group(0) @binding(3) var<storage, read> factors: array<f32>;
@group(0) @binding(4) var<storage, read> summands: array<f32>;
// Gradient of the result.
@group(0) @binding(5) var<storage, read> dy: array<f32>;

override ACTIVATION_KIND: u32 = 0u;

struct ChannelPart {
    row: u32,
    // First number, and number of numbers.
    base: u32,
    count: u32,
    // Mean and scale of the row.
    own: vec2<f32>,
    factor: f32,
    summand: f32,
}

// Returns the number of channels of all pictures.
fn all_channels() -> u32 {
    return call.rows * (call.length / call.run);
}

// Returns the factor of a channel, counted over all pictures.
fn factor_of(place: u32) -> f32 {
    if call.has_affine == 1u {
        return factors[place % (call.groups * (call.length / call.run))];
    }
    return 1.0;
}

// Returns the part with a number; the last channel's for numbers beyond the parts.
fn channel_part(number: u32) -> ChannelPart {
    let channels = call.length / call.run;
    let place = min(number / call.channel_parts, all_channels() - 1u);
    let first = number % call.channel_parts * PART;
    var part: ChannelPart;
    part.row = place / channels;
    part.base = place * call.run + first;
    part.count = min(call.run - first, PART);
    part.own = mean_and_scale(part.row);
    part.factor = factor_of(place);
    if call.has_affine == 1u {
        part.summand = summands[place % (call.groups * channels)];
    }
    return part;
}

// Returns the normalised number and the gradient before the activation.
fn normalised(part: ChannelPart, at: u32) -> vec2<f32> {
    let v = (x[at] - part.own.x) * part.own.y;
    return vec2<f32>(v, dy[at] * activation_slope(ACTIVATION_KIND, v * part.factor + part.summand));
}
