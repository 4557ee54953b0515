// Pictures with depth, and where a point lies in them. A kernel that uses this has `call` with
// `height` and `width`, and the arrays `rgb` [views, 3, pixels], `distances` [views, pixels] along
// the unit ray (world units) and `cameras`: per view the rows of R (world from camera) with the
// position as the fourth column, then focal lengths and principal point, px.
// CPU version: cpu/small/rgbd.rs.

// Returns K^-1 (u, v, 1) of a position, px.
fn ray(view: u32, at: vec2<f32>) -> vec3<f32> {
    let k = cameras[view * 4u + 3u];
    return vec3<f32>((at - k.zw) / k.xy, 1.0);
}

// Returns the position of the centre of a pixel, px.
fn centre(pixel: vec2<u32>) -> vec2<f32> {
    return vec2<f32>(pixel) + 0.5;
}

fn index(view: u32, pixel: vec2<u32>) -> u32 {
    return (view * call.height + pixel.y) * call.width + pixel.x;
}

// Returns the camera z of a pixel's surface.
fn surface_z(view: u32, pixel: vec2<u32>) -> f32 {
    return distances[index(view, pixel)] / length(ray(view, centre(pixel)));
}

fn colour(view: u32, pixel: vec2<u32>) -> vec3<f32> {
    let plane = call.height * call.width;
    let at = index(3u * view, pixel);
    return vec3<f32>(rgb[at], rgb[at + plane], rgb[at + 2u * plane]);
}

// Returns the world point at a position (px) and camera z.
fn world_point(view: u32, at: vec2<f32>, z: f32) -> vec3<f32> {
    let in_camera = vec4<f32>(ray(view, at) * z, 1.0);
    let c = view * 4u;
    return vec3<f32>(
        dot(cameras[c], in_camera),
        dot(cameras[c + 1u], in_camera),
        dot(cameras[c + 2u], in_camera),
    );
}

// Returns position (px) and camera z of a world point; z is 0 outside the picture.
fn projected(view: u32, point: vec3<f32>) -> vec3<f32> {
    let c = view * 4u;
    let away = point - vec3<f32>(cameras[c].w, cameras[c + 1u].w, cameras[c + 2u].w);
    let p = cameras[c].xyz * away.x + cameras[c + 1u].xyz * away.y + cameras[c + 2u].xyz * away.z;
    let k = cameras[c + 3u];
    let at = k.xy * p.xy / p.z + k.zw;
    let size = vec2<f32>(f32(call.width), f32(call.height));
    let inside = all(at >= vec2<f32>()) && all(at < size) && p.z > 0.0;
    return select(vec3<f32>(), vec3<f32>(at, p.z), inside);
}

// Returns the first and the last of the 3x3 pixels around a position inside the picture.
fn around(at: vec2<f32>) -> vec4<u32> {
    let middle = vec2<u32>(at);
    let last = vec2<u32>(call.width, call.height) - 1u;
    return vec4<u32>(max(middle, vec2<u32>(1u)) - 1u, min(middle + 1u, last));
}

// Returns the sum of |difference of RGB| between `wanted` and the nearest colour of the 3x3 pixels
// around a position inside the picture.
fn colour_difference(view: u32, at: vec2<f32>, wanted: vec3<f32>) -> f32 {
    let window = around(at);
    var least = 3.4e38;
    for (var row = window.y; row <= window.w; row++) {
        for (var column = window.x; column <= window.z; column++) {
            let difference = abs(colour(view, vec2<u32>(column, row)) - wanted);
            least = min(least, difference.x + difference.y + difference.z);
        }
    }
    return least;
}
