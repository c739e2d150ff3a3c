// From a time to where particles are. The page and the worker that sorts both run this file.

// Return the shares of a uniform cubic B-spline's coefficients at a time. A natural one has no acceleration at
// its ends: the coefficients before the first and after the last continue those beside them.
function splineShares(time, count, natural) {
  const all = natural ? count + 2 : count, place = time * (all - 3);
  const first = Math.min(Math.max(Math.trunc(place), 0), all - 4), u = place - first, v = 1 - u;
  const shares = new Float64Array(all);
  shares[first] = (v * v * v) / 6;
  shares[first + 1] = (3 * u * u * u - 6 * u * u + 4) / 6;
  shares[first + 2] = (-3 * u * u * u + 3 * u * u + 3 * u + 1) / 6;
  shares[first + 3] = (u * u * u) / 6;
  if (!natural) return shares;
  const inner = shares.slice(1, -1);
  inner[0] += 2 * shares[0];
  inner[1] -= shares[0];
  inner[count - 1] += 2 * shares[all - 1];
  inner[count - 2] -= shares[all - 1];
  return inner;
}

// Return the cosines of a curve at a time, less those at the canonical time.
function cosineShares(time, { count, frames, padding }, canonicalTime) {
  const cosine = (t, k) => {
    const inside = (Math.min(Math.max(t, 0), 1) + padding) / (1 + 2 * padding);
    return Math.cos((Math.PI / (2 * frames)) * (2 * inside * (frames - 1) + 1) * k);
  };
  const scale = Math.sqrt(2 / frames);
  return Float64Array.from({ length: count }, (_, k) => scale * (cosine(time, k + 1) - cosine(canonicalTime, k + 1)));
}

// Return the time of the motion that images of a time show.
function motionTime({ timeOffsets }, time) {
  if (!timeOffsets) return time;
  const { times, offsets } = timeOffsets;
  let after = 0;
  while (after < times.length && times[after] < time) after++;
  if (after === 0 || after === times.length) return time + offsets[Math.min(after, times.length - 1)];
  const share = (time - times[after - 1]) / (times[after] - times[after - 1]);
  return time + (1 - share) * offsets[after - 1] + share * offsets[after];
}

// Fill maps (M, 3, 4) with what nodes add to the identity: a matrix and a shift, row by row.
function nodeMaps(scene, time, maps) {
  const { nodes, curve, canonicalTime } = scene, at = motionTime(scene, time);
  const spline = curve.kind === "spline";
  const shares = spline ? splineShares(at, curve.count, curve.natural) : cosineShares(at, curve, canonicalTime);
  const used = [...shares.keys()].filter((k) => shares[k]), sum = (values, width, m, i) => {
    let total = 0;
    for (const k of used) total += shares[k] * values[width * (m * curve.count + k) + i];
    return total;
  };
  const turn = nodes.rotations, numbers = turn ? turn.length / (nodes.count * curve.count) : 0;
  for (let m = 0; m < nodes.count; m++) {
    const [x, y, z, more] = [0, 1, 2, 3].map((i) => (i < numbers ? sum(turn, numbers, m, i) : 0));
    const w = 1 + more, s = 2 / Math.max(w * w + x * x + y * y + z * z, 1e-20);
    const rows = [
      -s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
      s * (x * y + w * z), -s * (x * x + z * z), s * (y * z - w * x),
      s * (x * z - w * y), s * (y * z + w * x), -s * (x * x + y * y),
    ];
    const [px, py, pz] = nodes.positions.subarray(3 * m, 3 * m + 3);
    for (let i = 0; i < 3; i++) {
      const [a, b, c] = [rows[3 * i], rows[3 * i + 1], rows[3 * i + 2]], to = 12 * m + 4 * i;
      maps[to] = a;
      maps[to + 1] = b;
      maps[to + 2] = c;
      maps[to + 3] = sum(nodes.translations, 3, m, i) - (a * px + b * py + c * pz);
    }
  }
}

// Fill points (N, 3) with the places of the first particles, which move; of all others they stay as they are.
function movePoints({ moving, places, links, weights }, maps, points) {
  for (let i = 0; i < moving; i++) {
    const x = places[3 * i], y = places[3 * i + 1], z = places[3 * i + 2];
    let dx = 0, dy = 0, dz = 0;
    for (let group = 0; group < links.length; group++) {
      const link = links[group], weight = weights[group];
      for (let j = 4 * i; j < 4 * i + 4; j++) {
        const w = weight[j];
        if (w === 0) continue;
        const m = 12 * link[j];
        dx += w * (maps[m] * x + maps[m + 1] * y + maps[m + 2] * z + maps[m + 3]);
        dy += w * (maps[m + 4] * x + maps[m + 5] * y + maps[m + 6] * z + maps[m + 7]);
        dz += w * (maps[m + 8] * x + maps[m + 9] * y + maps[m + 10] * z + maps[m + 11]);
      }
    }
    points[3 * i] = x + dx;
    points[3 * i + 1] = y + dy;
    points[3 * i + 2] = z + dz;
  }
}

// Sorts particles by distance, from far to near.
class Sorter {
  constructor(scene) {
    const { count, moving, places, links, weights } = scene;
    this.scene = { moving, places, links, weights };
    this.points = places.slice();
    this.keys = new Uint32Array(count);
    this.half = new Uint32Array(count);
    this.counts = new Uint32Array(65536);
  }

  // Return the numbers (N,) of all particles. Squares of distances are positive floats, whose bits are ordered
  // as they are: 16 bits at a time are sorted by counting, so that equal ones keep their order.
  sorted(maps, [x, y, z]) {
    const { points, keys, half, counts } = this, count = keys.length, order = new Uint32Array(count);
    if (maps) movePoints(this.scene, maps, points);
    const squares = new Float32Array(keys.buffer);
    for (let i = 0; i < count; i++) {
      const a = points[3 * i] - x, b = points[3 * i + 1] - y, c = points[3 * i + 2] - z;
      squares[i] = a * a + b * b + c * c;
    }
    for (const [shift, from, to] of [[0, null, half], [16, half, order]]) {
      counts.fill(0);
      for (let i = 0; i < count; i++) counts[(keys[i] >>> shift) & 65535]++;
      for (let bin = 65535, before = 0; bin >= 0; bin--) {
        const many = counts[bin];
        counts[bin] = before;
        before += many;
      }
      for (let i = 0; i < count; i++) {
        const particle = from ? from[i] : i;
        to[counts[(keys[particle] >>> shift) & 65535]++] = particle;
      }
    }
    return order;
  }
}

// What the worker does: it is sent a scene first, then node maps and eyes, and answers with orders.
function sortInWorker() {
  let sorter;
  self.onmessage = ({ data }) => {
    if (data.scene) {
      sorter = new Sorter(data.scene);
      return;
    }
    const start = performance.now(), order = sorter.sorted(data.maps, data.eye);
    self.postMessage({ order, milliseconds: performance.now() - start }, [order.buffer]);
  };
}
