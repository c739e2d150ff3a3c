// Draw a scene with WebGL 2: a pass that projects each particle once, then one rectangle a particle, from far
// to near, blended in floats where the browser can, then all of it over the background.

const ROW = 1024; // particles in a row of a texture
const BORDER = 15; // steps along a side of an image
const NODES = 256; // nodes in a row of their texture
const SMALL = 64; // pixels of a side of the blurred image that fills holes
const LAYERS = ["all", "moving", "resting"];

const PROJECT = `
uniform highp sampler2DArray particles;
uniform highp sampler2D nodes;
uniform mat3 rotation; // world to camera
uniform vec3 eye;
uniform vec2 focal, middle, size;
uniform float near, margin, blur, skew;
uniform vec3 radial; // of the lens
uniform vec2 tangential;
uniform float reach; // squared distance from the axis from which on the lens shows nothing
uniform int count, moving, inMotion, layer;
uniform float basis[TIMES];
uniform highp usampler2D order;
layout(location = 0) out uvec4 outA; // pixel, and the longer axis of the ellipse, pixels
layout(location = 1) out uvec4 outB; // length of the other axis, logarithm of the opacity, colour

ivec2 cell;
vec4 of(int k) { return texelFetch(particles, ivec3(cell, k), 0); }
vec3 harmonic(int k) { return of(FIRST_HARMONIC + k).rgb; }

void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);
  int i = int(texelFetch(order, here, 0).r);
  cell = ivec2(i % ROW, i / ROW);
  outA = uvec4(0);
  outB = uvec4(0, floatBitsToUint(-1e9), 0, 0);
  bool moves = i < moving, goes = i < inMotion; // by nodes; by more than images show
  if (here.y * ROW + here.x >= count || layer == 1 && !goes || layer == 2 && goes) return;

  vec4 place = of(0), q = normalize(of(1));
  mat3 linear = mat3(1);
  vec3 point = place.xyz;
  if (moves) {
    mat3 added = mat3(0); // row by row
    vec3 shift = vec3(0);
    for (int g = 0; g < LINKS; g++) {
      vec4 link = of(3 + 2 * g), weight = of(4 + 2 * g);
      for (int j = 0; j < 4; j++) {
        if (weight[j] == 0.0) continue;
        int m = int(link[j]);
        ivec2 at = ivec2(3 * (m % NODES), m / NODES);
        vec4 r0 = weight[j] * texelFetch(nodes, at, 0);
        vec4 r1 = weight[j] * texelFetch(nodes, at + ivec2(1, 0), 0);
        vec4 r2 = weight[j] * texelFetch(nodes, at + ivec2(2, 0), 0);
        added += mat3(r0.xyz, r1.xyz, r2.xyz);
        shift += vec3(r0.w, r1.w, r2.w);
      }
    }
    linear += transpose(added);
    point = linear * point + shift;
  }

  vec3 away = point - eye, local = rotation * away;
  if (!(local.z > near)) return;
  vec2 plane = local.xy / local.z;
  float r2 = dot(plane, plane), px = plane.x, py = plane.y;
  if (!(r2 < reach)) return;
  float bent = 1.0 + r2 * (radial.x + r2 * (radial.y + r2 * radial.z));
  float slope = 2.0 * (radial.x + r2 * (2.0 * radial.y + r2 * 3.0 * radial.z));
  vec2 lensed = bent * plane + 2.0 * px * py * tangential + tangential.yx * (r2 + 2.0 * plane * plane);
  float xy = slope * px * py + 2.0 * (tangential.x * px + tangential.y * py);
  float xx = bent + slope * px * px + 2.0 * tangential.x * py + 6.0 * tangential.y * px;
  float yy = bent + slope * py * py + 2.0 * tangential.y * px + 6.0 * tangential.x * py;
  vec2 pixel = focal * lensed + vec2(skew * lensed.y, 0) + middle;
  if (any(lessThan(pixel, vec2(-margin))) || any(greaterThan(pixel, size + margin))) return;

  float opacity = place.w;
#if OPACITIES > 0
  float logit = opacity;
  for (int k = 0; k < OPACITIES; k++) logit += basis[k] * of(FIRST_TIME + k).a;
  opacity = 1.0 / (1.0 + exp(-logit));
#endif
  if (!(255.0 * opacity > 1.0)) return;

  float w = q.w, x = q.x, y = q.y, z = q.z;
  mat3 axes = mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
  mat3 root = rotation * linear * axes;
  vec3 s = of(2).xyz, far = s * (transpose(root) * vec3(0, 0, 1));
  vec3 across = s * (transpose(root) * vec3(1, 0, 0)) - px * far;
  vec3 downward = s * (transpose(root) * vec3(0, 1, 0)) - py * far;
  vec3 v = (xy * across + yy * downward) / local.z;
  vec3 u = focal.x / local.z * (xx * across + xy * downward) + skew * v;
  v *= focal.y;
  float a = dot(u, u) + blur, b = dot(u, v), c = dot(v, v) + blur;
  vec3 normal = cross(u, v); // of a needle, a c - b b would lose all digits
  float determinant = dot(normal, normal) + (a + c - blur) * blur;
  if (!(determinant > 0.0 && determinant < 1e30)) return;
  float half_ = 0.5 * (a - c), wide = 0.5 * (a + c) + sqrt(half_ * half_ + b * b);
  // The longer axis: of the two columns that are along it, the one that is not 0.
  vec2 axis = a > c ? vec2(wide - c, b) : vec2(b, wide - a);
  axis = dot(axis, axis) > 1e-20 ? normalize(axis) : vec2(1, 0);

  vec3 d = away / length(away), color = 0.5 + 0.28209479177387814 * harmonic(0);
#if DEGREE > 0
  color += 0.4886025119029199 * (-d.y * harmonic(1) + d.z * harmonic(2) - d.x * harmonic(3));
#endif
#if DEGREE > 1
  xx = d.x * d.x, yy = d.y * d.y;
  float zz = d.z * d.z;
  color += 1.0925484305920792 * (d.x * d.y * harmonic(4) - d.y * d.z * harmonic(5) - d.x * d.z * harmonic(7));
  color += 0.31539156525252005 * (2.0 * zz - xx - yy) * harmonic(6) + 0.5462742152960396 * (xx - yy) * harmonic(8);
#endif
#if DEGREE > 2
  color -= 0.5900435899266435 * d.y * (3.0 * xx - yy) * harmonic(9);
  color += 2.890611442640554 * d.x * d.y * d.z * harmonic(10);
  color -= 0.4570457994644658 * (4.0 * zz - xx - yy) * (d.y * harmonic(11) + d.x * harmonic(13));
  color += 0.3731763325901154 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * harmonic(12);
  color += 1.445305721320277 * d.z * (xx - yy) * harmonic(14);
  color -= 0.5900435899266435 * d.x * (xx - 3.0 * yy) * harmonic(15);
#endif
  for (int k = 0; k < COLORS; k++) color += basis[k] * of(FIRST_TIME + k).rgb;

  color = max(color, 0.0);
  outA = floatBitsToUint(vec4(pixel, sqrt(wide) * axis));
  outB = uvec4(floatBitsToUint(vec2(sqrt(determinant / wide), log(opacity))), packHalf2x16(color.rg), packHalf2x16(color.bb));
}`;

const SPLAT_VERTEX = `
uniform highp usampler2D splatA, splatB;
uniform vec2 size;
out vec2 at;
flat out float logOpacity;
flat out vec3 color;
// A triangle around the unit circle: without a graphics card corners cost more than the pixels beside it.
const vec2 CORNERS[3] = vec2[3](vec2(-1.7320508, -1), vec2(1.7320508, -1), vec2(0, 2));
void main() {
  int number = gl_VertexID / 3;
  ivec2 cell = ivec2(number % ROW, number / ROW);
  uvec4 b = texelFetch(splatB, cell, 0);
  gl_Position = vec4(2, 2, 0, 1);
  logOpacity = uintBitsToFloat(b.y);
  color = vec3(0);
  at = vec2(0);
  float seen = 2.0 * (logOpacity + LOG_255);
  if (!(seen > 0.0)) return;
  vec4 a = uintBitsToFloat(texelFetch(splatA, cell, 0));
  color = vec3(unpackHalf2x16(b.z), unpackHalf2x16(b.w).x);
  at = sqrt(seen) * CORNERS[gl_VertexID % 3];
  vec2 along = a.zw, across = uintBitsToFloat(b.x) * normalize(vec2(-a.w, a.z));
  gl_Position = vec4(2.0 * (a.xy + at.x * along + at.y * across) / size - 1.0, 0, 1);
}`;

const SPLAT_FRAGMENT = `
in vec2 at;
flat in float logOpacity;
flat in vec3 color;
out vec4 drawn;
void main() {
  float power = logOpacity - 0.5 * dot(at, at);
  if (!(power > -LOG_255)) discard; // an alpha below a 255th
  float alpha = exp(power);
  drawn = vec4(alpha * color, alpha);
}`;

const WHOLE_VERTEX = `
void main() { gl_Position = vec4(4 * (gl_VertexID & 1) - 1, 2 * (gl_VertexID & 2) - 1, 0, 1); }`;

const OVER_FRAGMENT = `
uniform highp sampler2D target;
uniform highp sampler2D small;
uniform vec3 background;
uniform vec2 size;
uniform bool fills;
out vec4 drawn;
void main() {
  vec2 at = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y); // rows of the target run from the top
  vec4 seen = texelFetch(target, ivec2(at), 0);
  if (fills && seen.a < 0.996) {
    // Holes of an image that else is full get the colours around them, nearest first.
    float full = smoothstep(0.6, 0.8, textureLod(small, vec2(0.5), SMALLEST).a);
    for (float k = 0.0; k <= SMALLEST; k++) seen += full * (1.0 - seen.a) * textureLod(small, at / size, k);
  }
  drawn = vec4(seen.rgb + (1.0 - seen.a) * background, 1);
}`;

const SMALL_FRAGMENT = `
uniform highp sampler2D target;
uniform vec2 size;
out vec4 drawn;
void main() {
  vec4 sum = vec4(0);
  for (int k = 0; k < 64; k++) {
    vec2 at = (gl_FragCoord.xy - 0.5 + (vec2(k % 8, k / 8) + 0.5) / 8.0) / SMALL;
    sum += texelFetch(target, ivec2(at * size), 0) / 64.0;
  }
  drawn = sum;
}`;

const TRAIL_VERTEX = `
uniform highp sampler2D segments; // three texels each: from and when, to and when, colour and opacity
uniform mat3 rotation;
uniform vec3 eye;
uniform vec2 focal, middle, size;
uniform float near, width, now, length_;
out vec4 shade;
out float beside; // pixels from the middle of the line
const int CORNERS[6] = int[6](0, 1, 2, 2, 1, 3);
void main() {
  int number = gl_VertexID / 6, corner = CORNERS[gl_VertexID % 6];
  ivec2 cell = ivec2(3 * (number % ROW), number / ROW);
  vec4 start = texelFetch(segments, cell, 0), end = texelFetch(segments, cell + ivec2(1, 0), 0);
  vec4 tint = texelFetch(segments, cell + ivec2(2, 0), 0);
  vec2 times = vec2(start.w, end.w);
  vec3 a = rotation * (start.xyz - eye), b = rotation * (end.xyz - eye);
  bool first = (corner & 1) == 0;
  float side = float(corner >> 1) * 2.0 - 1.0, time = first ? times.x : times.y;
  float age = now - time;
  gl_Position = vec4(2, 2, 0, 1);
  shade = vec4(tint.rgb, tint.a * clamp(1.0 - age / length_, 0.0, 1.0));
  beside = 0.0;
  if (a.z <= near || b.z <= near || times.x >= now || now - times.y >= length_) return;
  if (!first && times.y > now) b = mix(a, b, (now - times.x) / (times.y - times.x));
  vec2 p = focal * a.xy / a.z + middle, r = focal * b.xy / b.z + middle, along = r - p;
  along = dot(along, along) > 1e-8 ? normalize(along) : vec2(1, 0);
  beside = (0.5 * width + 1.0) * side;
  vec2 pixel = (first ? p : r) + beside * vec2(-along.y, along.x);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0, 1);
}`;

const TRAIL_FRAGMENT = `
in vec4 shade;
in float beside;
uniform float width;
out vec4 drawn;
void main() {
  float alpha = shade.a * clamp(0.5 * width + 0.5 - abs(beside), 0.0, 1.0);
  drawn = vec4(alpha * shade.rgb, alpha);
}`;

// Return what a camera's lens is for an image of another size, in which its own is wholly seen; or which it fills.
function fitted(lens, width, height, fills = false) {
  const sides = [width / lens.width, height / lens.height], scale = fills ? Math.max(...sides) : Math.min(...sides);
  return {
    focal: [lens.fx * scale, lens.fy * scale],
    middle: [
      lens.cx * scale + (width - lens.width * scale) / 2,
      lens.cy * scale + (height - lens.height * scale) / 2,
    ],
    size: [width, height],
    skew: (lens.skew ?? 0) * scale,
    bend: lens.lens ?? [0, 0, 0, 0, 0],
    near: lens.near,
  };
}

// Bend a point of the plane at distance 1 as a lens (k1, k2, k3, p1, p2) does; with what x and y gain by x and y.
function bent([k1, k2, k3, p1, p2], [x, y]) {
  const r2 = x * x + y * y, scale = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3));
  return {
    x: x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y: y * scale + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
    xx: scale + slope * x * x + 2 * p1 * y + 6 * p2 * x, xy: slope * x * y + 2 * p1 * x + 2 * p2 * y,
    yy: scale + slope * y * y + 2 * p2 * x + 6 * p1 * y,
  };
}

// Return the point that a lens bends to (x, y), by Newton's method from the axis; where the lens shows none, as
// it folds before, one on this side of the fold.
function straightened(bend, [x, y]) {
  let place = [0, 0], here = bent(bend, place), pace = 1;
  for (let step = 0; step < 40; step++) {
    const { xx, xy, yy } = here, dx = here.x - x, dy = here.y - y, factor = pace / (xx * yy - xy * xy);
    if (Math.hypot(dx, dy) < 1e-12) break;
    const tried = [place[0] - factor * (yy * dx - xy * dy), place[1] - factor * (xx * dy - xy * dx)];
    const there = bent(bend, tried), regular = there.xx > 0 && there.xx * there.yy > there.xy * there.xy;
    const closer = regular && Math.hypot(there.x - x, there.y - y) < Math.hypot(dx, dy);
    if (closer) [place, here] = [tried, there];
    pace = closer ? Math.min(2 * pace, 1) : pace / 2;
  }
  return place;
}

// Return the squared distance from the axis from which on a view shows nothing: somewhat beyond its border.
// Farther out the lens's polynomial may fold points back into the image.
function reachOf({ bend, focal, middle, size, skew }) {
  if (!bend.some(Boolean)) return 1e8;
  let most = 0;
  for (let k = 0; k <= BORDER; k++) {
    const [u, v] = size.map((side) => (k / BORDER) * side);
    for (const [across, down] of [[u, 0], [u, size[1]], [0, v], [size[0], v]]) {
      const y = (down - middle[1]) / focal[1], x = (across - middle[0] - skew * y) / focal[0];
      const place = straightened(bend, [x, y]);
      most = Math.max(most, place[0] ** 2 + place[1] ** 2);
    }
  }
  return 1.3 * most;
}

// Return f_k(time), by which coefficients of colour and opacity over time count.
function timeBasis({ canonicalTime }, time, count) {
  const at = (k) => Math.cos(Math.PI * k * time) - Math.cos(Math.PI * k * canonicalTime);
  return Float32Array.from({ length: Math.max(count, 1) }, (_, k) => at(k + 1));
}

class Renderer {
  constructor(canvas, scene) {
    const options = { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" };
    const gl = (this.gl = canvas.getContext("webgl2", options));
    if (!gl) throw new Error("no WebGL 2");
    this.canvas = canvas;
    this.scene = scene;
    const floats = gl.getExtension("EXT_color_buffer_float"), blend = gl.getExtension("EXT_float_blend");
    const halves = floats || gl.getExtension("EXT_color_buffer_half_float");
    this.formats = [gl.RGBA8, gl.UNSIGNED_BYTE];
    if (halves) this.formats = [gl.RGBA16F, gl.HALF_FLOAT];
    if (floats && blend) this.formats = [gl.RGBA32F, gl.FLOAT];
    this.bits = { [gl.RGBA8]: 8, [gl.RGBA16F]: 16, [gl.RGBA32F]: 32 }[this.formats[0]];
    this.build();
  }

  build() {
    const { gl, scene } = this, rows = Math.max(1, Math.ceil(scene.count / ROW));
    const degree = Math.sqrt(scene.harmonics.length) - 1, links = scene.links.length;
    const colors = scene.colorOverTime.length, opacities = scene.opacityOverTime.length;
    const harmonics = 3 + 2 * links, times = harmonics + scene.harmonics.length;
    const defines = {
      ROW, NODES, LINKS: links, DEGREE: degree, COLORS: colors, OPACITIES: opacities,
      TIMES: Math.max(colors, opacities, 1), FIRST_HARMONIC: harmonics, FIRST_TIME: times,
      LOG_255: Math.log(255), SMALL: `${SMALL}.0`, SMALLEST: `${Math.log2(SMALL)}.0`,
    };
    this.times = Math.max(colors, opacities);
    this.project = this.program(WHOLE_VERTEX, PROJECT, defines);
    this.splat = this.program(SPLAT_VERTEX, SPLAT_FRAGMENT, defines);
    this.over = this.program(WHOLE_VERTEX, OVER_FRAGMENT, defines);
    this.shrink = this.program(WHOLE_VERTEX, SMALL_FRAGMENT, defines);
    this.trail = this.program(TRAIL_VERTEX, TRAIL_FRAGMENT, defines);
    this.fillParticles(rows, times + this.times);
    const nodes = scene.nodes?.count ?? 1; // every sampler has a texture of its kind
    this.nodeSize = [3 * Math.min(NODES, nodes), Math.ceil(nodes / NODES)];
    this.nodes = this.texture(gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, ...this.nodeSize);
    this.maps = scene.nodes ? new Float32Array(4 * this.nodeSize[0] * this.nodeSize[1]) : null;
    this.splats = [0, 1].map(() => {
      const texture = this.texture(gl.TEXTURE_2D);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, ROW, rows);
      return texture;
    });
    this.projected = this.framebuffer(this.splats);
    this.rows = rows;
    this.small = this.texture(gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, Math.log2(SMALL) + 1, this.bits > 8 ? gl.RGBA16F : gl.RGBA8, SMALL, SMALL);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    this.shrunk = this.framebuffer([this.small]);
    this.target = null;
    this.order = this.texture(gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, ROW, rows);
    this.ordered = new Uint32Array(ROW * rows);
    this.segments = null;
  }

  fillParticles(rows, layers) {
    const { gl, scene } = this, { count } = scene;
    this.particles = this.texture(gl.TEXTURE_2D_ARRAY);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA32F, ROW, rows, layers);
    const room = new Float32Array(4 * ROW * rows);
    let layer = 0;
    const put = (values, width, last = null) => {
      room.fill(0);
      for (let i = 0; i < values.length / width; i++) {
        for (let j = 0; j < width; j++) room[4 * i + j] = values[width * i + j];
      }
      if (last) for (let i = 0; i < count; i++) room[4 * i + 3] = last[i];
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer++, ROW, rows, 1, gl.RGBA, gl.FLOAT, room);
    };
    put(scene.places, 3, scene.opacityOverTime.length ? scene.logits : scene.opacity);
    put(scene.quaternions, 4);
    put(scene.scales, 3);
    scene.links.forEach((links, group) => {
      put(links, 4);
      put(scene.weights[group], 4);
    });
    for (const values of scene.harmonics) put(values, 3);
    const none = new Float32Array(0);
    for (let k = 0; k < this.times; k++) put(scene.colorOverTime[k] ?? none, 3, scene.opacityOverTime[k]);
  }

  program(vertex, fragment, defines) {
    const { gl } = this, program = gl.createProgram();
    const head = Object.entries(defines).map(([name, value]) => `#define ${name} ${value}\n`).join("");
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, `#version 300 es\n${head}precision highp float;\nprecision highp int;\n${text}`);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(`${gl.getProgramInfoLog(program)} ${logs.join(" ")}`);
    }
    const places = new Map();
    const place = (name) => {
      if (!places.has(name)) places.set(name, gl.getUniformLocation(program, name));
      return places.get(name);
    };
    return { program, place };
  }

  texture(kind) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(kind, texture);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, side, gl.NEAREST);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(kind, side, gl.CLAMP_TO_EDGE);
    return texture;
  }

  framebuffer(textures) {
    const { gl } = this, framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    textures.forEach((texture, i) => {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
    });
    gl.drawBuffers(textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
    return framebuffer;
  }

  resizeTarget(width, height) {
    const { gl } = this;
    if (this.target?.width === width && this.target.height === height) return;
    if (this.target) {
      gl.deleteTexture(this.target.texture);
      gl.deleteFramebuffer(this.target.framebuffer);
    }
    const texture = this.texture(gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.formats[0], width, height);
    this.target = { width, height, texture, framebuffer: this.framebuffer([texture]) };
  }

  // Take node maps and the time's part of colours; then particles are where they are at that time of the film.
  setTime(filmTime) {
    const [first, last] = this.scene.span, time = Math.min(Math.max((filmTime - first) / (last - first), 0), 1);
    this.time = time;
    this.basis = timeBasis(this.scene, time, this.times);
    if (!this.scene.nodes) return;
    nodeMaps(this.scene, time, this.maps);
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.nodes);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ...this.nodeSize, gl.RGBA, gl.FLOAT, this.maps);
  }

  // Take an order of all particles, from far to near.
  setOrder(order) {
    const { gl } = this;
    this.ordered.set(order);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, this.rows, gl.RED_INTEGER, gl.UNSIGNED_INT, this.ordered);
  }

  setCamera({ program, place }, view) {
    const { gl } = this, { eye, right, down, ahead } = view;
    gl.useProgram(program);
    gl.uniformMatrix3fv(place("rotation"), true, [...right, ...down, ...ahead]);
    gl.uniform3fv(place("eye"), eye);
    for (const name of ["focal", "middle", "size"]) gl.uniform2fv(place(name), view[name]);
    gl.uniform1f(place("near"), view.near);
  }

  bind(program, name, unit, texture, kind = this.gl.TEXTURE_2D) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(kind, texture);
    gl.uniform1i(program.place(name), unit);
    gl.activeTexture(gl.TEXTURE0);
  }

  // Draw particles into the target of the view's size, premultiplied. ``view`` has an eye, unit vectors right,
  // down and ahead, focal lengths, middle and size in pixels; ``layer`` is one of LAYERS.
  drawTarget(view, layer) {
    const { gl, scene, project, splat } = this, [width, height] = view.size;
    this.resizeTarget(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projected);
    gl.viewport(0, 0, ROW, this.rows);
    gl.disable(gl.BLEND);
    this.setCamera(project, view);
    gl.uniform1f(project.place("margin"), scene.margin * Math.max(width, height));
    gl.uniform1f(project.place("blur"), scene.blur);
    gl.uniform1f(project.place("skew"), view.skew);
    gl.uniform3fv(project.place("radial"), view.bend.slice(0, 3));
    gl.uniform2fv(project.place("tangential"), view.bend.slice(3));
    gl.uniform1f(project.place("reach"), reachOf(view));
    gl.uniform1i(project.place("count"), scene.count);
    gl.uniform1i(project.place("moving"), scene.moving);
    gl.uniform1i(project.place("inMotion"), scene.inMotion);
    gl.uniform1i(project.place("layer"), LAYERS.indexOf(layer));
    gl.uniform1fv(project.place("basis"), this.basis);
    this.bind(project, "particles", 0, this.particles, gl.TEXTURE_2D_ARRAY);
    this.bind(project, "order", 1, this.order);
    this.bind(project, "nodes", 2, this.nodes);
    gl.drawArrays(gl.TRIANGLES, 0, 3);

    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(splat.program);
    ["splatA", "splatB"].forEach((name, i) => this.bind(splat, name, i, this.splats[i]));
    gl.uniform2fv(splat.place("size"), view.size);
    gl.drawArrays(gl.TRIANGLES, 0, 3 * scene.count);
    gl.disable(gl.BLEND);
  }

  // Draw the target, and trails where there are any, onto the canvas, which has its size; by a share of less
  // than 1 over what is there. ``fills``: holes get the colours around them.
  drawCanvas(view, background, fills = false, trailWidth = 0, share = 1) {
    const { gl, over, shrink } = this;
    if (fills) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.shrunk);
      gl.viewport(0, 0, SMALL, SMALL);
      gl.useProgram(shrink.program);
      this.bind(shrink, "target", 0, this.target.texture);
      gl.uniform2fv(shrink.place("size"), view.size);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      gl.bindTexture(gl.TEXTURE_2D, this.small);
      gl.generateMipmap(gl.TEXTURE_2D);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, ...view.size);
    gl.useProgram(over.program);
    this.bind(over, "target", 0, this.target.texture);
    gl.uniform3fv(over.place("background"), background);
    this.bind(over, "small", 1, this.small);
    gl.uniform2fv(over.place("size"), view.size);
    gl.uniform1i(over.place("fills"), fills);
    if (share < 1) gl.enable(gl.BLEND);
    gl.blendColor(0, 0, 0, share);
    gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.BLEND);
    if (trailWidth && this.segments) this.drawTrails(view, trailWidth);
  }

  drawTrails(view, width) {
    const { gl, trail } = this;
    this.setCamera(trail, view);
    gl.uniform1f(trail.place("width"), width);
    gl.uniform1f(trail.place("now"), this.time);
    gl.uniform1f(trail.place("length_"), TRAIL_LENGTH);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.bind(trail, "segments", 0, this.segments);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * this.segmentCount);
    gl.disable(gl.BLEND);
  }

  // Take segments, 12 numbers each: from where and when, to where and when, colour and opacity.
  setTrails(segments) {
    const { gl } = this, rows = Math.max(1, Math.ceil(segments.length / (12 * ROW)));
    this.segmentCount = segments.length / 12;
    this.segments = this.texture(gl.TEXTURE_2D);
    const room = new Float32Array(12 * ROW * rows);
    room.set(segments);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 3 * ROW, rows, 0, gl.RGBA, gl.FLOAT, room);
  }

  // Read the target as floats, four a pixel, row by row from the top.
  readTarget() {
    const { gl } = this, { width, height, framebuffer } = this.target;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    if (this.bits === 8) {
      const bytes = new Uint8Array(4 * width * height);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      return Float32Array.from(bytes, (value) => value / 255);
    }
    const out = new Float32Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, out);
    return out;
  }
}

const TRAIL_POINTS = 300, TRAIL_TIMES = 96, TRAIL_LENGTH = 0.25;
const TRAIL_OPACITY = 0.3, TRAIL_WAY = 0.01; // least opacity, and way as a share of the distance from the eye

// Return some of a list, evenly spread over it.
function spread(list, count) {
  const many = Math.min(count, list.length);
  return Array.from({ length: many }, (_, k) => list[Math.floor(((k + 0.5) * list.length) / many)]);
}

// Return the paths of some opaque particles that go some way, as segments for ``setTrails``. Particles lie in
// the file along a curve that fills space, so that every n-th one is about evenly spread.
function trailsOf(scene) {
  const solid = [...Array(scene.inMotion).keys()].filter((i) => scene.opacity[i] > TRAIL_OPACITY);
  const tried = spread(solid, 5 * TRAIL_POINTS);
  const pick = (values, width) => {
    const out = new Float32Array(width * tried.length);
    tried.forEach((i, row) => out.set(values.subarray(width * i, width * (i + 1)), width * row));
    return out;
  };
  const few = {
    moving: tried.length, places: pick(scene.places, 3),
    links: scene.links.map((group) => pick(group, 4)), weights: scene.weights.map((group) => pick(group, 4)),
  };
  const maps = new Float32Array(12 * (scene.nodes?.count ?? 0)), points = [];
  for (let k = 0; k <= TRAIL_TIMES && tried.length; k++) {
    nodeMaps(scene, k / TRAIL_TIMES, maps);
    points.push(few.places.slice());
    movePoints(few, maps, points[k]);
  }
  const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
  const at = (k, row) => points[k].subarray(3 * row, 3 * row + 3);
  const least = TRAIL_WAY * apart(scene.cameras[0].eye, scene.focus);
  const went = (row) => Math.max(...points.map((_, k) => apart(at(k, row), at(0, row))));
  const rows = spread([...tried.keys()].filter((row) => went(row) > least), TRAIL_POINTS), out = [];
  rows.forEach((row, i) => {
    const hue = (i / rows.length) * 2 * Math.PI;
    const tint = [0, 1, 2].map((c) => 0.6 + 0.4 * Math.cos(hue - (2 * Math.PI * c) / 3));
    for (let k = 0; k < TRAIL_TIMES; k++) {
      for (const end of [k, k + 1]) out.push(...at(end, row), end / TRAIL_TIMES);
      out.push(...tint, 0.9);
    }
  });
  return Float32Array.from(out);
}
