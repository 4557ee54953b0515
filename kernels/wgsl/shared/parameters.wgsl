// Parameters of Gaussians under optimisation (kernels/src/layout/parameters.rs), and the Gaussians that a step
// leaves out. A kernel that uses this has `call`, an OptimiseUniform.

// Returns the elements of a parameter of a form.
fn elements_of(form: u32) -> u32 {
    switch form {
        case FORM_LOGIT, FORM_COMMON_FACTOR: { return 1u; }
        case FORM_DIRECTION: { return 4u; }
        default: { return 3u; }
    }
}

// Returns whether the step leaves out Gaussian i: a hash of both, SplitMix64's number after (step, i) times
// its increment.
fn is_left_out(i: u32) -> bool {
    let key = wide_times(vec2<u32>(i, call.step), vec2<u32>(0x7F4A7C15u, 0x9E3779B9u));
    return splitmix(key).y < call.limit;
}
