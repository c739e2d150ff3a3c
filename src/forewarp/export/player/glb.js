// Read scene.glb (docs/format.md): a glTF 2.0 binary of Gaussians, with the motion beside them.

const KNOWN_FEATURES = ["windows", "quaternions"];
const COMPONENTS = {
  5120: [Int8Array, 127], 5121: [Uint8Array, 255], 5122: [Int16Array, 32767],
  5123: [Uint16Array, 65535], 5125: [Uint32Array, 1], 5126: [Float32Array, 1],
};
const WIDTHS = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4 };
const SPLATS = "KHR_gaussian_splatting", MOTION = "FOREWARP_gaussian_motion", MESHOPT = "EXT_meshopt_compression";

// Return the two chunks of a binary glTF: its description and its bytes.
function chunksOf(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 20 || view.getUint32(0, true) !== 0x46546c67 || view.getUint32(4, true) !== 2) {
    throw new Error("expected a glTF 2.0 binary");
  }
  if (view.getUint32(8, true) > bytes.length) throw new Error("the file is cut off");
  const length = view.getUint32(12, true), start = 20 + length;
  const gltf = JSON.parse(new TextDecoder().decode(bytes.subarray(20, start)));
  const binary = bytes.subarray(start + 8, start + 8 + view.getUint32(start, true));
  return [gltf, binary];
}

// Decode mode ATTRIBUTES of EXT_meshopt_compression, version 0: each byte of an element as the difference
// from that of the element before, 16 differences at a time in 0, 2, 4 or 8 bits.
function decodeAttributes(source, count, stride) {
  if (source[0] !== 0xa0) throw new Error("expected meshopt attributes of version 0");
  const out = new Uint8Array(count * stride), last = source.slice(source.length - stride);
  const most = Math.min((8192 / stride) & ~15, 256);
  let at = 1;
  for (let start = 0; start < count; start += most) {
    const many = Math.min(most, count - start), groups = (many + 15) >> 4;
    for (let k = 0; k < stride; k++) {
      const header = at;
      at += (groups + 3) >> 2;
      let value = last[k];
      for (let group = 0; group < groups; group++) {
        const mode = (source[header + (group >> 2)] >> (2 * (group & 3))) & 3;
        const bits = [0, 2, 4, 8][mode], sentinel = mode === 3 ? -1 : (1 << bits) - 1;
        let extra = at + 2 * bits;
        for (let j = 0; j < 16; j++) {
          let code = 0;
          if (mode) {
            const bit = j * bits;
            code = (source[at + (bit >> 3)] >> (8 - bits - (bit & 7))) & ((1 << bits) - 1);
            if (code === sentinel) code = source[extra++];
          }
          value = (value + ((code >> 1) ^ -(code & 1))) & 255;
          const element = 16 * group + j;
          if (element < many) {
            out[(start + element) * stride + k] = value;
            last[k] = value;
          }
        }
        at = extra;
      }
    }
  }
  return out;
}

// Undo a filter of EXT_meshopt_compression in place.
function unfilter(bytes, filter) {
  if (filter === "EXPONENTIAL") {
    const whole = new Int32Array(bytes.buffer), real = new Float32Array(bytes.buffer);
    for (let i = 0; i < whole.length; i++) real[i] = 2 ** (whole[i] >> 24) * ((whole[i] << 8) >> 8);
  } else if (filter === "QUATERNION") {
    const q = new Int16Array(bytes.buffer);
    for (let i = 0; i < q.length; i += 4) {
      const scale = Math.SQRT1_2 / (q[i + 3] | 3), largest = q[i + 3] & 3;
      const x = q[i] * scale, y = q[i + 1] * scale, z = q[i + 2] * scale;
      const w = Math.sqrt(Math.max(0, 1 - x * x - y * y - z * z));
      [x, y, z, w].forEach((value, j) => (q[i + ((largest + 1 + j) & 3)] = Math.round(32767 * value)));
    }
  } else if (filter && filter !== "NONE") {
    throw new Error(`unknown filter ${filter}`);
  }
}

// Return a function that reads an accessor as numbers: a Float32Array of count x width.
function accessorsOf(gltf, binary) {
  const views = new Map();

  function viewBytes(number) {
    if (!views.has(number)) {
      const view = gltf.bufferViews[number], packed = view.extensions?.[MESHOPT];
      const from = packed ?? view, start = from.byteOffset ?? 0;
      if (from.buffer !== 0 || start + from.byteLength > binary.length) throw new Error("the file is cut off");
      let bytes = binary.subarray(start, start + from.byteLength);
      if (packed) {
        if (packed.mode !== "ATTRIBUTES") throw new Error(`unknown mode ${packed.mode}`);
        bytes = decodeAttributes(bytes, packed.count, packed.byteStride);
        unfilter(bytes, packed.filter);
      }
      views.set(number, bytes);
    }
    return views.get(number);
  }

  return (number) => {
    const accessor = gltf.accessors[number], width = WIDTHS[accessor.type], { count } = accessor;
    const [Kind, most] = COMPONENTS[accessor.componentType], size = Kind.BYTES_PER_ELEMENT;
    const stride = gltf.bufferViews[accessor.bufferView].byteStride ?? size * width;
    const bytes = viewBytes(accessor.bufferView), start = accessor.byteOffset ?? 0;
    if (start + stride * (count - 1) + size * width > bytes.length) throw new Error("the file is cut off");
    const out = new Float32Array(count * width), packed = bytes.slice(start);
    const values = new Kind(packed.buffer, 0, Math.floor(packed.length / size));
    const scale = accessor.normalized ? 1 / most : 1;
    for (let i = 0; i < count; i++) {
      for (let j = 0; j < width; j++) {
        const value = values[(i * stride) / size + j] * scale;
        out[i * width + j] = accessor.normalized ? Math.max(value, -1) : value;
      }
    }
    return out;
  };
}

// Return the global matrices (16 numbers, column by column) of a glTF's nodes.
function globalMatrices(nodes) {
  const found = nodes.map(() => null);
  function local(node) {
    if (node.matrix) return node.matrix;
    const [x, y, z, w] = node.rotation ?? [0, 0, 0, 1], [tx, ty, tz] = node.translation ?? [0, 0, 0];
    const [a, b, c] = node.scale ?? [1, 1, 1];
    return [
      a * (1 - 2 * (y * y + z * z)), a * 2 * (x * y + w * z), a * 2 * (x * z - w * y), 0,
      b * 2 * (x * y - w * z), b * (1 - 2 * (x * x + z * z)), b * 2 * (y * z + w * x), 0,
      c * 2 * (x * z + w * y), c * 2 * (y * z - w * x), c * (1 - 2 * (x * x + y * y)), 0,
      tx, ty, tz, 1,
    ];
  }
  function times(a, b) {
    return b.map((_, i) => [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + (i & 3)] * b[(i & ~3) + k], 0));
  }
  function visit(number, above) {
    if (found[number]) return;
    const matrix = (found[number] = above ? times(above, local(nodes[number])) : local(nodes[number]));
    for (const child of nodes[number].children ?? []) visit(child, matrix);
  }
  const children = new Set(nodes.flatMap((node) => node.children ?? []));
  nodes.forEach((_, number) => children.has(number) || visit(number, null));
  return found;
}

// Return the cameras in the axes of the mesh: eye, unit vectors right, down and ahead, and the lens in pixels.
function camerasOf(gltf, matrices, turn) {
  const turned = (x, y, z) => [0, 1, 2].map((i) => turn[4 * i] * x + turn[4 * i + 1] * y + turn[4 * i + 2] * z);
  return gltf.nodes.flatMap((node, number) => {
    const camera = gltf.cameras?.[node.camera], m = matrices[number];
    if (!camera?.perspective) return [];
    const { yfov, aspectRatio = 1, znear, zfar } = camera.perspective, height = 400 / Math.min(1, aspectRatio);
    const f = height / (2 * Math.tan(yfov / 2)), width = aspectRatio * height;
    const lens = { width, height, fx: f, fy: f, cx: width / 2, cy: height / 2, ...camera.extras };
    lens.near = Math.max(znear / 10, zfar / 50);
    return [{
      lens, time: lens.time, eye: turned(m[12] - turn[12], m[13] - turn[13], m[14] - turn[14]),
      right: turned(m[0], m[1], m[2]), down: turned(-m[4], -m[5], -m[6]), ahead: turned(-m[8], -m[9], -m[10]),
    }];
  });
}

// Return what a primitive has of our extension; nothing of others.
const motionOf = (primitive) => primitive?.extensions?.[SPLATS]?.extensions?.[MOTION];

// Read the particles of a primitive: arrays of numbers, one row a particle; those that move come first.
function readParticles(primitive, gltf, read) {
  const motion = motionOf(primitive), named = primitive.attributes, harmonics = [];
  if (!motion) throw new Error(`expected ${SPLATS} with ${MOTION}`);
  for (let degree = 0; `${SPLATS}:SH_DEGREE_${degree}_COEF_0` in named; degree++) {
    for (let n = 0; n <= 2 * degree; n++) harmonics.push(read(named[`${SPLATS}:SH_DEGREE_${degree}_COEF_${n}`]));
  }
  const places = read(named.POSITION), weights = (motion.weights ?? []).map(read), { nodes, timeOffsets } = motion;
  for (let i = 0; i < (motion.moving ?? 0); i++) {
    const at = weights.flatMap((group) => [0, 1, 2, 3].map((j) => [group, 4 * i + j]));
    const sum = at.reduce((total, [group, j]) => total + group[j], 0) || 1;
    for (const [group, j] of at) group[j] /= sum;
  }
  return {
    count: places.length / 3, moving: nodes ? motion.moving : 0,
    inMotion: nodes ? motion.inMotion ?? motion.moving : 0, places, harmonics, weights,
    quaternions: read(named[`${SPLATS}:ROTATION`]), scales: read(named[`${SPLATS}:SCALE`]),
    opacity: read(named[`${SPLATS}:OPACITY`]), logits: motion.opacityLogits === undefined ? null : read(motion.opacityLogits),
    links: (motion.links ?? []).map(read), curve: motion.curve,
    nodes: nodes && {
      count: gltf.accessors[nodes.positions].count, positions: read(nodes.positions),
      translations: read(nodes.translations),
      rotations: nodes.rotations === undefined ? null : read(nodes.rotations),
    },
    timeOffsets: timeOffsets && { times: read(timeOffsets.times), offsets: read(timeOffsets.offsets) },
    colorOverTime: (motion.colorOverTime ?? []).map(read), opacityOverTime: (motion.opacityOverTime ?? []).map(read),
    canonicalTime: motion.canonicalTime, blur: motion.blur,
  };
}

// Return particles, and after them the last ones of others, which rest.
function joined(own, others, many) {
  const joinRows = (a, b) => {
    if (a === null) return null;
    const out = new Float32Array(a.length + (b.length / others.count) * many);
    out.set(a);
    out.set(b.subarray(b.length - (out.length - a.length)), a.length);
    return out;
  };
  const rows = {}, lists = {};
  for (const name of ["places", "quaternions", "scales", "opacity", "logits"]) rows[name] = joinRows(own[name], others[name]);
  for (const name of ["harmonics", "colorOverTime", "opacityOverTime"]) {
    if (own[name].length !== others[name].length) throw new Error("windows of other coefficients");
    lists[name] = own[name].map((values, k) => joinRows(values, others[name][k]));
  }
  return { ...own, ...rows, ...lists, count: own.count + many };
}

// Read a scene: the windows of a film, in their order; of all others one.
function readScene(bytes) {
  const [gltf, binary] = chunksOf(bytes), read = accessorsOf(gltf, binary);
  const mesh = gltf.nodes.findIndex((node) => node.mesh !== undefined);
  const primitive = gltf.meshes?.[gltf.nodes[mesh]?.mesh]?.primitives[0], motion = motionOf(primitive);
  if (!motion) throw new Error(`expected ${SPLATS} with ${MOTION}`);
  if (!/^1\./.test(motion.version)) throw new Error(`expected ${MOTION} 1, but got ${motion.version}`);
  const foreign = (motion.features ?? []).filter((name) => !KNOWN_FEATURES.includes(name));
  if (foreign.length) throw new Error(`this page does not know ${foreign.join(", ")}`);
  const matrices = globalMatrices(gltf.nodes), turn = matrices[mesh];
  const setting = {
    seconds: motion.seconds ?? 4, background: motion.background ?? [1, 1, 1],
    focus: motion.focus ?? [0, 0, 0], trust: gltf.nodes[mesh].extras?.trust_degrees, margin: motion.margin ?? 0.125,
    up: [turn[1], turn[5], turn[9]], cameras: camerasOf(gltf, matrices, turn),
  };
  const first = readParticles(primitive, gltf, read), { shared = 0, fade = 0, list = [{}] } = motion.windows ?? {};
  return list.map(({ mesh: number, span = [0, 1], from = 0 }) => {
    const own = number === undefined ? first : readParticles(gltf.meshes[number].primitives[0], gltf, read);
    return { ...setting, ...(own === first ? own : joined(own, first, shared)), span, from, fade };
  });
}
