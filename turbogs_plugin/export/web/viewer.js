// A viewer of 3D Gaussians in WebGL 2: sorted instanced quads, with the projection of TurboGS's own renderer.
"use strict";

const TEXTURE_WIDTH = 4096;
const NEAR = 0.01;

function fromBase64(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// The file has the first byte of every Gaussian, then the second of every one, ...; a texture has Gaussian by Gaussian.
function toRows(planes, count, stride) {
  const texels = (count * stride) / 16;
  const height = Math.max(1, Math.ceil(texels / TEXTURE_WIDTH));
  const rows = new Uint8Array(height * TEXTURE_WIDTH * 16);
  for (let byte = 0; byte < stride; byte++) {
    const start = byte * count;
    for (let i = 0; i < count; i++) rows[i * stride + byte] = planes[start + i];
  }
  return { rows, height };
}

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D model;
uniform mat3 rotation;       // world to camera
uniform vec3 translation;
uniform vec3 center;         // of the camera
uniform vec4 lens;           // fx, fy, cx, cy in pixels
uniform vec2 size;           // of the picture
uniform vec3 ranges;         // largest coefficient of degrees 1, 2, 3
uniform vec3 limits;         // eps2d, alpha_min, near
in uint index;
out vec2 offset; flat out vec3 conic; flat out vec4 color;
uvec4 texel(uint place) { return texelFetch(model, ivec2(place % ${TEXTURE_WIDTH}u, place / ${TEXTURE_WIDTH}u), 0); }
void main() {
  uint first = index * uint(TEXELS);
  uvec4 a = texel(first), b = texel(first + 1u);
  vec3 mean = uintBitsToFloat(a.xyz);
  vec2 s01 = unpackHalf2x16(a.w), s2o = unpackHalf2x16(b.x), rg = unpackHalf2x16(b.y);
  vec3 scale = exp(vec3(s01, s2o.x));
  float opacity = s2o.y;
  vec3 rgb = vec3(rg, unpackHalf2x16(b.z).x);
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);            // outside, unless it is drawn
  vec3 p = rotation * mean + translation;
  if (p.z < limits.z || opacity < limits.y) return;
  uint largest = b.w >> 30;
  vec3 stored = (vec3((b.w >> 20) & 1023u, (b.w >> 10) & 1023u, b.w & 1023u) / 1023.0 - 0.5) * sqrt(2.0);
  float rest = sqrt(max(0.0, 1.0 - dot(stored, stored)));
  vec4 q = largest == 0u ? vec4(rest, stored) : largest == 1u ? vec4(stored.x, rest, stored.yz)
         : largest == 2u ? vec4(stored.xy, rest, stored.z) : vec4(stored, rest);   // w, x, y, z
  float w = q.x, x = q.y, y = q.z, z = q.w;
  mat3 axes = mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
                   2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
                   2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
  vec2 at = p.xy / p.z;
  vec2 screen = lens.xy * at + lens.zw;
  vec2 margin = 0.15 * size / lens.xy;
  vec2 held = clamp(at, -(lens.zw / lens.xy + margin), (size - lens.zw) / lens.xy + margin);
  mat3 world = transpose(rotation);                  // its columns are the camera's axes in the world
  vec3 across = lens.x / p.z * (world[0] - held.x * world[2]), down = lens.y / p.z * (world[1] - held.y * world[2]);
  vec3 u = vec3(dot(across, axes[0]), dot(across, axes[1]), dot(across, axes[2])) * scale;
  vec3 v = vec3(dot(down, axes[0]), dot(down, axes[1]), dot(down, axes[2])) * scale;
  float xx = dot(u, u), yy = dot(v, v), xy = dot(u, v);
  vec3 turned = cross(u, v);
  float determinant = dot(turned, turned) + limits.x * (xx + yy + limits.x);
  xx += limits.x; yy += limits.x;
  conic = vec3(yy, -xy, xx) / determinant;
  float extent = min(3.33, sqrt(max(0.0, 2.0 * log(opacity / limits.y))));
  float middle = 0.5 * (xx + yy), spread = length(vec2(0.5 * (xx - yy), xy));
  float longer = middle + spread, shorter = max(middle - spread, 0.5 * limits.x);
  vec2 major = spread < 1e-6 * middle ? vec2(1.0, 0.0)
             : normalize(xx >= yy ? vec2(longer - yy, xy) : vec2(xy, longer - xx));
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 reach = extent * sqrt(vec2(longer, shorter)) + 0.5;
  offset = corner.x * reach.x * major + corner.y * reach.y * vec2(-major.y, major.x);
  vec2 place = screen + offset;
  if (any(greaterThan(abs(screen - 0.5 * size), 0.5 * size + reach.x))) return;
#if BANDS > 0
  vec3 d = normalize(mean - center);
  float basis[15];
  basis[0] = -0.48860251190292 * d.y; basis[1] = 0.48860251190292 * d.z; basis[2] = -0.48860251190292 * d.x;
#if BANDS > 3
  float zz = d.z * d.z, cos2 = d.x * d.x - d.y * d.y, sin2 = 2.0 * d.x * d.y;
  basis[3] = 0.5462742152960395 * sin2; basis[4] = -1.092548430592079 * d.z * d.y;
  basis[5] = 0.9461746957575601 * zz - 0.3153915652525201; basis[6] = -1.092548430592079 * d.z * d.x;
  basis[7] = 0.5462742152960395 * cos2;
#endif
#if BANDS > 8
  float ring = 0.4570457994644658 - 2.285228997322329 * zz;
  float cos3 = d.x * cos2 - d.y * sin2, sin3 = d.x * sin2 + d.y * cos2;
  basis[8] = -0.5900435899266435 * sin3; basis[9] = 1.445305721320277 * d.z * sin2; basis[10] = ring * d.y;
  basis[11] = d.z * (1.865881662950577 * zz - 1.119528997770346); basis[12] = ring * d.x;
  basis[13] = 1.445305721320277 * d.z * cos2; basis[14] = -0.5900435899266435 * cos3;
#endif
  uint words[(TEXELS - 2) * 4];
  for (int t = 0; t < TEXELS - 2; t++) {
    uvec4 found = texel(first + 2u + uint(t));
    words[4 * t] = found.x; words[4 * t + 1] = found.y; words[4 * t + 2] = found.z; words[4 * t + 3] = found.w;
  }
  for (int band = 0; band < BANDS; band++) {
    float range = band < 3 ? ranges.x : band < 8 ? ranges.y : ranges.z;
    for (int channel = 0; channel < 3; channel++) {
      int j = 3 * band + channel;
      float code = float(int(words[j >> 2] << uint(24 - 8 * (j & 3))) >> 24) / 127.0;
      rgb[channel] += basis[band] * range * code * abs(code);
    }
  }
#endif
  color = vec4(max(rgb, 0.0), opacity);
  gl_Position = vec4(2.0 * place.x / size.x - 1.0, 1.0 - 2.0 * place.y / size.y, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 limits;
in vec2 offset; flat in vec3 conic; flat in vec4 color;
out vec4 shown;
void main() {
  float power = 0.5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y) + conic.y * offset.x * offset.y;
  float alpha = min(0.999, color.a * exp(-power));
  if (alpha < limits.y || power < 0.0) discard;
  shown = vec4(color.rgb * alpha, alpha);
}`;

// Sums are kept in 16-bit floats where there are such targets, and shown by one more quad: 8 bits would round them
// away.
const COPY_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0, 0.0, 1.0); }`;
const COPY_FRAGMENT = `#version 300 es
precision highp float; precision highp sampler2D;
uniform sampler2D sums;
out vec4 shown;
void main() { shown = vec4(texelFetch(sums, ivec2(gl_FragCoord.xy), 0).rgb, 1.0); }`;

class SplatViewer {
  // model: what `packing.py` writes: { count, stride, bands, ranges, eps2d, alpha_min, planes: Uint8Array }.
  constructor(canvas, model) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.gl = gl; this.canvas = canvas; this.model = model;
    const { rows, height } = toRows(model.planes, model.count, model.stride);
    if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("the model is too large for this graphics card");
    this.means = new Float32Array(3 * model.count);
    const floats = new Float32Array(rows.buffer);
    for (let i = 0; i < model.count; i++)
      for (let axis = 0; axis < 3; axis++) this.means[3 * i + axis] = floats[(i * model.stride) / 4 + axis];
    const defines = `#define TEXELS ${model.stride / 16}\n#define BANDS ${model.bands}\n`;
    this.program = this.link(VERTEX.replace("es\n", "es\n" + defines), FRAGMENT);
    this.copy = this.link(COPY_VERTEX, COPY_FRAGMENT);
    this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, TEXTURE_WIDTH, height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT,
      new Uint32Array(rows.buffer));
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    this.order = new Uint32Array(model.count);
    this.keys = [new Uint32Array(model.count), new Uint32Array(model.count)];
    this.passes = [new Uint32Array(model.count), this.order];
    this.counts = new Uint32Array(65536);
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    this.indices = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    const place = gl.getAttribLocation(this.program, "index");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribIPointer(place, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(place, 1);
    this.empty = gl.createVertexArray();
    this.wide = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.target = null;
  }

  link(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  // Far to near, by two passes over 16 bits of the depth: the bits of positive floats are in the order of the floats.
  sort(camera) {
    const { means, counts, model } = this, [rx, ry, rz] = camera.rotation.slice(6), t = camera.translation[2];
    const depth = new Float32Array(1), bits = new Uint32Array(depth.buffer);
    let shown = 0;
    const [keys, next] = this.keys, [first, order] = this.passes;
    for (let i = 0; i < model.count; i++) {
      depth[0] = rx * means[3 * i] + ry * means[3 * i + 1] + rz * means[3 * i + 2] + t;
      if (!(depth[0] >= NEAR)) continue;
      keys[shown] = ~bits[0] >>> 0;
      order[shown++] = i;
    }
    for (const [shift, from, to, source, target] of [[0, order, first, keys, next], [16, first, order, next, keys]]) {
      counts.fill(0);
      for (let i = 0; i < shown; i++) counts[(source[i] >>> shift) & 65535]++;
      for (let key = 0, sum = 0; key < 65536; key++) { const count = counts[key]; counts[key] = sum; sum += count; }
      for (let i = 0; i < shown; i++) {
        const place = counts[(source[i] >>> shift) & 65535]++;
        to[place] = from[i];
        target[place] = source[i];
      }
    }
    return shown;
  }

  resize() {
    const gl = this.gl, { width, height } = this.canvas;
    if (!this.wide || (this.target && this.target.width === width && this.target.height === height)) return;
    if (this.target) { gl.deleteFramebuffer(this.target.frame); gl.deleteTexture(this.target.texture); }
    const texture = gl.createTexture(), frame = gl.createFramebuffer();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE) this.wide = null;
    this.target = { texture, frame, width, height };
  }

  // camera: { rotation: 9 numbers, row by row; translation: 3; lens: [fx, fy, cx, cy] } for a picture of the canvas.
  draw(camera) {
    const gl = this.gl, { width, height } = this.canvas;
    this.resize();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.wide ? this.target.frame : null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.program);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    const at = (name) => gl.getUniformLocation(this.program, name);
    const R = camera.rotation, t = camera.translation;
    const center = [0, 1, 2].map((axis) => -(R[axis] * t[0] + R[3 + axis] * t[1] + R[6 + axis] * t[2]));
    gl.uniformMatrix3fv(at("rotation"), true, R);
    gl.uniform3fv(at("translation"), t);
    gl.uniform3fv(at("center"), center);
    gl.uniform4fv(at("lens"), camera.lens);
    gl.uniform2f(at("size"), width, height);
    gl.uniform3fv(at("ranges"), this.model.ranges);
    gl.uniform3f(at("limits"), this.model.eps2d, this.model.alpha_min, NEAR);
    const shown = this.sort(camera);
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, this.order.subarray(0, shown), gl.DYNAMIC_DRAW);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, shown);
    gl.disable(gl.BLEND);
    if (!this.wide) return;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.copy);
    gl.bindTexture(gl.TEXTURE_2D, this.target.texture);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
}
