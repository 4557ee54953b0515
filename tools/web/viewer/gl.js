// Draws Gaussians by WebGL2.
"use strict";

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
uniform sampler2D geometry;
uniform usampler2D colours;
uniform mat3 cameraFromWorld;
uniform vec3 eye;
uniform vec2 focal, centre, size;
uniform vec4 limit;
uniform float lowpass;
uniform int degree, texels;
in uint index;
out vec2 sigmas;
flat out vec4 colour;

ivec2 place(sampler2D of, int at) {
  int width = textureSize(of, 0).x;
  return ivec2(at % width, at / width);
}

uvec4 packed16(int texel) {
  int width = textureSize(colours, 0).x;
  int at = texels * int(index) + texel;
  return texelFetch(colours, ivec2(at % width, at / width), 0);
}

vec3 coefficient(int k) {
  vec3 out_;
  uvec4 group = packed16(3 * k / 16);
  int first = 3 * k / 16;
  for (int c = 0; c < 3; c++) {
    int byte = 3 * k + c;
    if (byte / 16 != first) { first = byte / 16; group = packed16(first); }
    out_[c] = float((group[byte / 4 % 4] >> uint(8 * (byte % 4))) & 255u);
  }
  return k == 0 ? (out_ / 255.0 - 0.5) / 0.15 : (out_ - 128.0) / 128.0;
}

vec3 shColour(vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.5 + ${SH_C0} * coefficient(0);
  if (degree > 0) {
    sum += ${SH[0]} * y * coefficient(1) + ${SH[1]} * z * coefficient(2) + ${SH[2]} * x * coefficient(3);
  }
  if (degree > 1) {
    sum += ${SH[3]} * x * y * coefficient(4) + ${SH[4]} * y * z * coefficient(5)
      + ${SH[5]} * (2.0 * zz - xx - yy) * coefficient(6) + ${SH[6]} * x * z * coefficient(7)
      + ${SH[7]} * (xx - yy) * coefficient(8);
  }
  if (degree > 2) {
    sum += ${SH[8]} * y * (3.0 * xx - yy) * coefficient(9) + ${SH[9]} * x * y * z * coefficient(10)
      + ${SH[10]} * y * (4.0 * zz - xx - yy) * coefficient(11)
      + ${SH[11]} * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(12)
      + ${SH[12]} * x * (4.0 * zz - xx - yy) * coefficient(13)
      + ${SH[13]} * z * (xx - yy) * coefficient(14) + ${SH[14]} * x * (xx - 3.0 * yy) * coefficient(15);
  }
  return max(sum, 0.0);
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  int at = 3 * int(index);
  vec4 a = texelFetch(geometry, place(geometry, at), 0);
  vec4 b = texelFetch(geometry, place(geometry, at + 1), 0);
  vec4 c = texelFetch(geometry, place(geometry, at + 2), 0);
  if (a.w < ${ALPHA_MIN}) return;
  vec3 p = cameraFromWorld * (a.xyz - eye);
  vec2 slope = p.xy / p.z;
  vec2 bent = clamp(slope, limit.xz, limit.yw);
  mat3 toWorld = transpose(cameraFromWorld);
  vec3 ju = focal.x / p.z * (toWorld[0] - bent.x * toWorld[2]);
  vec3 jv = focal.y / p.z * (toWorld[1] - bent.y * toWorld[2]);
  mat3 sigma = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
  vec3 su = sigma * ju;
  float xx = dot(ju, su) + lowpass, xy = dot(jv, su), yy = dot(jv, sigma * jv) + lowpass;
  float mid = 0.5 * (xx + yy);
  float half_ = length(vec2(0.5 * (xx - yy), xy));
  float long_ = mid + half_;
  float short_ = max(mid - half_, 1e-6);
  vec2 axis = half_ > 1e-9 * mid ? vec2(xy, long_ - xx) : vec2(1.0, 0.0);
  axis = dot(axis, axis) > 0.0 ? normalize(axis) : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float reach = sqrt(2.0 * log(a.w * 255.0) + 1e-4);
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  sigmas = reach * corner;
  vec2 px = focal * slope + centre
    + sigmas.x * sqrt(long_) * axis + sigmas.y * sqrt(short_) * vec2(-axis.y, axis.x);
  colour = vec4(shColour(normalize(a.xyz - eye)), a.w);
  gl_Position = vec4(2.0 * px.x / size.x - 1.0, 1.0 - 2.0 * px.y / size.y, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 sigmas;
flat in vec4 colour;
out vec4 result;
void main() {
  float alpha = min(colour.a * exp(-0.5 * dot(sigmas, sigmas)), ${ALPHA_MAX});
  if (alpha < ${ALPHA_MIN}) discard;
  result = vec4(colour.rgb * alpha, alpha);
}`;

const COPY_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

const COPY_FRAGMENT = `#version 300 es
precision highp float;
uniform highp sampler2D picture;
uniform vec3 background;
uniform float levels, fade;
out vec4 result;
void main() {
  vec4 own = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  vec2 size = vec2(textureSize(picture, 0)), at = gl_FragCoord.xy / size;
  vec3 fill = background;
  if (own.a < 0.998) {
    for (float level = levels; level > 0.5; level -= 1.0) {
      vec2 d = 0.5 * exp2(level) / size;
      vec4 sum = 0.25 * (textureLod(picture, at + d, level) + textureLod(picture, at - d, level)
        + textureLod(picture, at + vec2(d.x, -d.y), level) + textureLod(picture, at + vec2(-d.x, d.y), level));
      fill = sum.rgb + (1.0 - sum.a) * fill;
    }
  }
  vec3 rgb = own.rgb + (1.0 - own.a) * fill;
  vec2 middle = 2.0 * at - 1.0;
  result = vec4(mix(rgb, background, fade * min(0.25 + dot(middle, middle), 1.0)), 1.0);
}`;

/** Names of drivers that draw WebGL on the processor. */
const SOFTWARE = /swiftshader|llvmpipe|softpipe|swrast|software|basic render/i;

/**
 * Draws by WebGL2: instanced quads, farthest first, into half floats where the browser can. Where nothing covers a
 * pixel, its surroundings fill it: the same picture at half the size, a quarter and so on.
 */
class GlPainter {
  /** `hardware` refuses a driver that draws on the processor, where `CpuPainter` is faster. */
  constructor(canvas, hardware) {
    const gl = canvas.getContext("webgl2", {
      alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true,
      failIfMajorPerformanceCaveat: hardware,
    });
    if (!gl) throw new Error("This browser has no WebGL2.");
    const names = gl.getExtension("WEBGL_debug_renderer_info");
    const driver = gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
    if (hardware && SOFTWARE.test(driver)) throw new Error(`${driver} draws on the processor.`);
    this.gl = gl;
    this.canvas = canvas;
    this.half = Boolean(
      gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"),
    );
    this.splats = this.program(VERTEX, FRAGMENT);
    this.copy = this.program(COPY_VERTEX, COPY_FRAGMENT);
    this.indices = gl.createBuffer();
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    const place = gl.getAttribLocation(this.splats, "index");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribIPointer(place, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(place, 1);
    this.empty = gl.createVertexArray();
  }

  get name() {
    return "WebGL2";
  }

  /** Longest side of a picture, px. */
  get sideMax() {
    const { gl } = this;
    return Math.min(gl.getParameter(gl.MAX_TEXTURE_SIZE), ...gl.getParameter(gl.MAX_VIEWPORT_DIMS));
  }

  program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const log = gl.getAttachedShaders(program).map((s) => gl.getShaderInfoLog(s)).join("");
      throw new Error(`shader: ${log}${gl.getProgramInfoLog(program)}`);
    }
    return program;
  }

  /** A texture of `rows` rows for each `width` Gaussians of a scene. */
  texture(unitIndex, internal, rows, count) {
    const { gl, width } = this;
    const height = Math.max(1, rows * Math.ceil(count / width));
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error("this graphics card holds no scene of this size");
    }
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unitIndex);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, internal, width, height);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  /** Textures for a scene, without texels. */
  open(scene) {
    const { gl } = this;
    this.width = Math.min(4096, gl.getParameter(gl.MAX_TEXTURE_SIZE));
    this.texels = Math.ceil(3 * (scene.degree + 1) ** 2 / 16);
    return [
      this.texture(0, gl.RGBA32F, 3, scene.count),
      this.texture(1, gl.RGBA32UI, this.texels, scene.count),
    ];
  }

  /** Fills the rows of the textures that begin with Gaussian `first`. */
  fill([geometry, colours], scene, first) {
    const { gl, width, texels } = this;
    const count = Math.min(width, scene.count - first);
    const numbers = new Float32Array(12 * width);
    const used = 3 * (scene.degree + 1) ** 2, stride = 16 * texels;
    const bytes = new Uint8Array(stride * width);
    for (let k = 0, i = first; k < count; k++, i++) {
      numbers.set(scene.means.subarray(3 * i, 3 * i + 3), 12 * k);
      numbers[12 * k + 3] = scene.opacities[i];
      numbers.set(scene.covariances.subarray(6 * i, 6 * i + 6), 12 * k + 4);
      bytes.set(scene.colours.subarray(3 * i, 3 * i + 3), stride * k);
      const from = scene.restStride * i;
      bytes.set(scene.rest.subarray(from, from + used - 3), stride * k + 3);
    }
    const row = first / width;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, geometry);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 3 * row, width, 3, gl.RGBA, gl.FLOAT, numbers);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, colours);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, texels * row, width, texels, gl.RGBA_INTEGER,
      gl.UNSIGNED_INT, new Uint32Array(bytes.buffer));
  }

  close(textures, scene) {
    [this.geometry, this.colours].forEach((t) => t && this.gl.deleteTexture(t));
    [this.geometry, this.colours] = textures;
    this.degree = scene.degree;
    this.scene = scene;
  }

  load(scene) {
    const textures = this.open(scene);
    for (let i = 0; i < scene.count; i += this.width) this.fill(textures, scene, i);
    this.close(textures, scene);
    this.sorter = new Sorter(scene.count);
  }

  /** Replaces the scene by a longer one with the same beginning; false where `pause` ends the work. */
  async extend(scene, pause) {
    const textures = this.open(scene);
    for (let i = 0; i < scene.count; i += this.width) {
      if (!await pause()) {
        textures.forEach((t) => this.gl.deleteTexture(t));
        return false;
      }
      this.fill(textures, scene, i);
    }
    this.close(textures, scene);
    return true;
  }

  target(width, height) {
    if (!this.half) return null;
    const { gl } = this;
    if (this.size !== `${width}x${height}`) {
      if (this.frame) {
        gl.deleteTexture(this.picture);
        gl.deleteFramebuffer(this.frame);
      }
      this.picture = gl.createTexture();
      gl.activeTexture(gl.TEXTURE2);
      gl.bindTexture(gl.TEXTURE_2D, this.picture);
      this.halves = Math.floor(Math.log2(Math.max(width, height)));
      gl.texStorage2D(gl.TEXTURE_2D, this.halves + 1, gl.RGBA16F, width, height);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
      this.frame = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
      gl.framebufferTexture2D(
        gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.picture, 0);
      if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) this.half = false;
      this.size = `${width}x${height}`;
    }
    return this.half ? this.frame : null;
  }

  /** Draws `chosen` Gaussians, or all; `fade` of 1 leaves the background's colour only, first at the edges. */
  draw(view, background, chosen, fade = 0) {
    const { gl, splats } = this;
    const n = this.sorter.sort(this.scene, view, chosen);
    const order = this.sorter.order.subarray(0, n).reverse();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target(view.width, view.height));
    gl.viewport(0, 0, view.width, view.height);
    if (this.half) gl.clearColor(0, 0, 0, 0);
    else gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(splats);
    const at = (name) => gl.getUniformLocation(splats, name);
    gl.uniform1i(at("geometry"), 0);
    gl.uniform1i(at("colours"), 1);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.geometry);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.colours);
    // Columns of the matrix are the rows of the rotation, which is its inverse's transpose.
    gl.uniformMatrix3fv(at("cameraFromWorld"), false, [...view.rotation]);
    gl.uniform3f(at("eye"), ...view.eye);
    gl.uniform2f(at("focal"), view.fx, view.fy);
    gl.uniform2f(at("centre"), view.cx, view.cy);
    gl.uniform2f(at("size"), view.width, view.height);
    gl.uniform4f(at("limit"), ...view.limit.flat());
    gl.uniform1f(at("lowpass"), view.lowpass);
    gl.uniform1i(at("degree"), this.degree);
    gl.uniform1i(at("texels"), this.texels);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, n);
    if (this.half) {
      gl.disable(gl.BLEND);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.useProgram(this.copy);
      const of = (name) => gl.getUniformLocation(this.copy, name);
      gl.uniform1i(of("picture"), 2);
      gl.uniform3f(of("background"), ...background);
      gl.uniform1f(of("levels"), this.halves);
      gl.uniform1f(of("fade"), fade);
      gl.activeTexture(gl.TEXTURE2);
      gl.bindTexture(gl.TEXTURE_2D, this.picture);
      gl.generateMipmap(gl.TEXTURE_2D);
      gl.bindVertexArray(this.empty);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 3);
    }
  }

  /** RGBA of the last frame, rows from the top. */
  pixels(width, height) {
    const { gl } = this;
    const rows = new Uint8Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rows);
    const out = new Uint8ClampedArray(rows.length);
    for (let y = 0; y < height; y++) {
      out.set(rows.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
    }
    return out;
  }
}
