// Decoder of compact model files (.fgz), see docs/format.md. It repeats the operations of
// foldgauss.video.compression.quantize.dequantize in their order, for the same bits. No dependency on a browser.
// `decode` takes a whole file. To read one in parts: `headerBytes`, `readHeader`, `decodeMotion`, then `decodeChunk`.

const FEATURES = ["class", "size", "stretch", "duration", "opacity"];
const COLORS = ["luma", "blue", "green"];
const WHOLE = ["cell", "class", "degree", "path"];
const AXES = [
  [0.5773502691896258, 0.5773502691896258, 0.5773502691896258],
  [-0.7071067811865476, 0.0, 0.7071067811865476],
  [-0.408248290463863, 0.8164965809277261, -0.408248290463863],
];
const WIDEST = { time: 0.125, angle: 0.125, size: 0.35, stretch: 0.5, duration: 0.5, opacity: 1.0 };
const MAGIC = [0x8b, 0x46, 0x47, 0x5a, 0x0d, 0x0a, 0x1a, 0x0a], VERSION = 6, FIXED = 20;
const NODES = 130, CONTEXTS = 256, MODELS = 3, MEMORY = 400, LARGEST_BITS = 30, FARTHEST = 120, FINEST = -48;
const WEIGHT = 29491, RATE = 6, MARGIN = 32;
const KNOTS = [
  22, 36, 60, 98, 162, 267, 439, 720, 1179, 1921, 3108, 4971, 7812, 11955, 17625, 24743, 32768,
  40793, 47911, 53581, 57724, 60565, 62428, 63615, 64357, 64816, 65097, 65269, 65374, 65438, 65476, 65500, 65514,
];
const DAMAGED = "The file is damaged. Copy it again, or compress again.";
const LN2 = 0.6931471805599453, SQRT2 = 1.4142135623730951;
const NEIGHBORS = 4, CANDIDATES = 16, TIME = 0.3;
/** Limits of headers, so that a small file cannot claim much memory. */
const MOST_PER_BYTE = 32, MOST_DEGREE = 15, MOST_CELL_BITS = 24, MOST_CHUNKS = 1024;
/** Numbers per Gaussian of each leaf; only a model with shared paths has `path_index`. */
const WIDTHS = {
  loc: () => 2, log_scale: () => 2, angle_logit: () => 1, time_loc_logit: () => 1, log_time_scale: () => 1,
  coefficients: (degree) => 2 * degree, opacity_logit: () => 1, color_dc: () => 3, path_index: () => 1,
};

const LOGISTIC = Int32Array.from({ length: 4096 }, (_, place) => {
  const k = place >> 7, part = place & 127;
  return (KNOTS[k] * (128 - part) + KNOTS[k + 1] * part + 64) >> 7;
});
const LOGIT = Int32Array.from({ length: 4096 }, (_, p) => {
  const found = LOGISTIC.findIndex((own) => own >= 16 * p + 8);
  return (found < 0 ? 4095 : found) - 2048;
});

const clip = (x, low, high) => Math.min(Math.max(x, low), high);

/** Class of a magnitude: 0, 1, 2, then 3 to 5, 6 to 11 and so on; 15 at most. */
function magnitudeClass(size) {
  let found = 0;
  for (let bound = 0.5; found < 15 && size >= bound; ) bound = ++found === 1 ? 1.5 : 2 * bound;
  return found;
}

/** What is known of a column before its values: here nothing, without contexts. */
export function emptyColumn(num) {
  return {
    num, has: () => true, contexts: () => [0, 0], origin: () => 0, step: () => 1, scale: () => 1,
    near: new Int32Array(0), width: 0,
  };
}

const START = 32768 * 512 + 2;

/** A node's state, p 512 + n, after a bit. */
function after(state, one) {
  const p = state >> 9, n = state & 511;
  const next = one ? p + Math.floor((65536 - p) / n) : p - Math.floor(p / n);
  return next * 512 + (n < MEMORY ? n + 1 : n);
}

/** A column's integers, Int32Array, from its bytes and what is known of it. */
export function decodeColumn(data, column) {
  const size = CONTEXTS * NODES;
  // Of each node in each context: the probability of a one times 512, plus the number of bits seen.
  const first = new Int32Array(size).fill(START), second = new Int32Array(size).fill(START);
  const third = new Int32Array(size).fill(START);
  const weights = new Float64Array(NODES * MODELS).fill(WEIGHT);
  let atFirst = 0, atSecond = 0, atThird = 0; // offsets of the contexts of the current value
  const range = Uint32Array.of(0, 0xffffffff, 0); // low, high, code; typed, since boxed numbers would be allocated for each bit
  let next = 0;
  const byte = () => (next < data.length ? data[next++] : (next++, 0));
  for (let k = 0; k < 4; k++) range[2] = (range[2] << 8) | byte();
  const bit = (p) => {
    const low = range[0], span = range[1] - low;
    const middle = low + (span >>> 16) * p + (((span & 0xffff) * p) >>> 16), one = range[2] <= middle;
    if (one) range[1] = middle; else range[0] = middle + 1;
    while (((range[0] ^ range[1]) & 0xff000000) === 0) {
      range[0] <<= 8;
      range[1] = (range[1] << 8) | 255;
      range[2] = (range[2] << 8) | byte();
    }
    return one;
  };
  const adaptiveBit = (node) => {
    const one = atFirst + node, other = atSecond + node, near = atThird + node, weight = MODELS * node;
    const l0 = LOGIT[first[one] >> 13], l1 = LOGIT[second[other] >> 13], l2 = LOGIT[third[near] >> 13];
    const total = Math.floor((l0 * weights[weight] + l1 * weights[weight + 1] + l2 * weights[weight + 2]) / 65536);
    const held = LOGISTIC[(total < -2047 ? -2047 : total > 2047 ? 2047 : total) + 2048];
    const mixed = held < MARGIN ? MARGIN : held > 65536 - MARGIN ? 65536 - MARGIN : held;
    const found = bit(mixed), error = RATE * ((found ? 65536 : 0) - mixed);
    weights[weight] += Math.floor((l0 * error) / 262144);
    weights[weight + 1] += Math.floor((l1 * error) / 262144);
    weights[weight + 2] += Math.floor((l2 * error) / 262144);
    first[one] = after(first[one], found);
    second[other] = after(second[other], found);
    third[near] = after(third[near], found);
    return found;
  };
  const values = new Int32Array(column.num), seen = new Float64Array(column.num);
  const expected = (i) => {
    let total = 0, found = 0;
    for (let k = 0; k < column.width; k++) {
      const j = column.near[column.width * i + k];
      if (j >= 0) { total += seen[j]; found++; }
    }
    if (found === 0) return 0;
    const ratio = ((total / found) * column.scale(i) - column.origin(i)) / column.step(i);
    return ratio >= 0 ? 16 + magnitudeClass(ratio) : 16 - magnitudeClass(Math.abs(ratio));
  };
  for (let i = 0; i < column.num; i++) {
    if (!column.has(i)) continue;
    const [one, other] = column.contexts(i);
    [atFirst, atSecond, atThird] = [one * NODES, other * NODES, expected(i) * NODES];
    if (!adaptiveBit(0)) {
      const negative = adaptiveBit(1);
      let exponent = 0;
      while (adaptiveBit(2 + exponent)) if (++exponent >= LARGEST_BITS) throw new Error(DAMAGED);
      let magnitude = 1, leading = 1;
      for (let b = 0; b < exponent; b++) {
        let one;
        if (leading < 4) {
          one = adaptiveBit(34 + 3 * exponent + leading - 1) ? 1 : 0;
          leading = 2 * leading + one;
        } else one = bit(32768) ? 1 : 0;
        magnitude = 2 * magnitude + one;
      }
      values[i] = negative ? -magnitude : magnitude;
    }
    seen[i] = (column.origin(i) + values[i] * column.step(i)) / column.scale(i);
  }
  if (next !== data.length + 3) throw new Error(DAMAGED);
  return values;
}

function power(halves) {
  let x = halves & 1 ? SQRT2 : 1;
  for (let n = Math.floor(halves / 2); n !== 0; n += n > 0 ? -1 : 1) x = n > 0 ? x * 2 : x / 2;
  return x;
}

const view = new DataView(new ArrayBuffer(8));
function log(x) {
  view.setFloat64(0, x);
  const head = view.getInt32(0);
  let e = ((head >> 20) & 0x7ff) - 1022;
  view.setInt32(0, (head & 0x800fffff) | (1022 << 20));
  let m = view.getFloat64(0);
  if (m < 0.7071067811865476) { m = 2 * m; e -= 1; }
  const s = (m - 1) / (m + 1), z = s * s;
  let total = 0;
  for (let k = 17; k > 0; k -= 2) total = total * z + 1 / k;
  return e * LN2 + 2 * s * total;
}
const logit = (x) => log(x) - log(1 - x);
/** Exponential of a number <= 0. */
function exp(x) {
  const held = Math.max(x, -690), e = Math.floor(held * (1 / LN2) + 0.5), rest = held - e * LN2;
  let total = 1;
  for (let k = 14; k > 0; k--) total = 1 + (total * rest) / k;
  return total * power(2 * e);
}
const inClip = (x) => Math.min(Math.max(x, 2 ** -24), 1 - 2 ** -24);

function legendre(degree) {
  const comb = (n, k) => { let c = 1; for (let j = 1; j <= k; j++) c = (c * (n - k + j)) / j; return c; };
  return Array.from({ length: degree + 1 }, (_, k) => {
    const row = new Float64Array(degree + 1);
    for (let j = 0; 2 * j <= k; j++) row[k - 2 * j] = ((j % 2 ? -1 : 1) * comb(k, j) * comb(2 * k - 2 * j, k)) / 2 ** k;
    return row;
  });
}

/** Middle and half-width of the span of time that a path describes. */
function spanOf(time, duration, reach) {
  const halves = clip(Math.floor(2 * (duration * (1 / LN2)) + 0.5), -FARTHEST, FARTHEST);
  const wide = reach * power(halves), first = Math.max(time - wide, 0), last = Math.min(time + wide, 1);
  return [(first + last) * 0.5, Math.max((last - first) * 0.5, 2 ** -40)];
}

/** Index of a cell along x, y or time. */
function along(cell, cells, axis) {
  let index = 0, place = 0;
  for (let k = 0; k < Math.max(...cells); k++)
    for (let a = 0; a < 3; a++)
      if (k < cells[a]) {
        if (a === axis) index |= ((cell >> place) & 1) << k;
        place++;
      }
  return index;
}

/** The latest Gaussians before each in its cell, else the one before it: rows of four indices, -1 for none. */
function findLatestInCell(cell, numCells) {
  const last = new Int32Array(numCells).fill(-1), before = new Int32Array(cell.length);
  const out = new Int32Array(NEIGHBORS * cell.length).fill(-1);
  for (let i = 0; i < cell.length; i++) {
    let j = (before[i] = last[cell[i]]), count = 0;
    for (; j >= 0 && count < NEIGHBORS; j = before[j]) out[NEIGHBORS * i + count++] = j;
    if (count === 0) out[NEIGHBORS * i] = i - 1;
    last[cell[i]] = i;
  }
  return out;
}

/** The nearest Gaussians before each, among the latest of its grid square and the adjacent ones. */
function findNearest(x, y, time, bits) {
  const side = 2 ** bits, num = x.length, square = (v) => clip(Math.floor((v + 0.5) * side), 0, side - 1);
  const last = new Int32Array(side * side).fill(-1), before = new Int32Array(num);
  const out = new Int32Array(NEIGHBORS * num).fill(-1), best = new Float64Array(NEIGHBORS);
  for (let i = 0; i < num; i++) {
    const column = square(x[i]), row = square(y[i]);
    best.fill(Infinity);
    for (let c = Math.max(column - 1, 0); c < Math.min(column + 2, side); c++)
      for (let r = Math.max(row - 1, 0); r < Math.min(row + 2, side); r++)
        for (let j = last[c * side + r], count = 0; j >= 0 && count < CANDIDATES; j = before[j], count++) {
          const dx = x[i] - x[j], dy = y[i] - y[j], dt = time[i] - time[j], far = dx * dx + dy * dy + dt * dt;
          let place = NEIGHBORS;
          while (place > 0 && far < best[place - 1]) place--;
          if (place === NEIGHBORS) continue;
          for (let k = NEIGHBORS - 1; k > place; k--) {
            best[k] = best[k - 1];
            out[NEIGHBORS * i + k] = out[NEIGHBORS * i + k - 1];
          }
          best[place] = far;
          out[NEIGHBORS * i + place] = j;
        }
    before[i] = last[column * side + row];
    last[column * side + row] = i;
  }
  return out;
}

/** The names of a file's columns in order. */
function columnNames({ degree, paths }) {
  const path = Array.from({ length: 2 * degree + 2 }, (_, k) => "xy"[k % 2] + (k >> 1));
  return [...WHOLE.slice(0, paths ? 4 : 3), ...FEATURES.slice(1), "time", ...path, "angle", ...COLORS];
}

/** The values of all columns of a chunk. */
function decodeColumns(header, { num_gaussians: num, cells }, streams, onColumn) {
  const { paths } = header, q = {}, v = {}, features = [], most = { degree: header.degree, path: paths?.num_paths };
  const [height, width] = header.size, longer = Math.max(height, width);
  const sides = [...(paths?.sides ?? [width / longer, height / longer]), 1], middles = [...(paths?.middle ?? [0, 0]), 0.5];
  const half = new Float64Array(num), one = () => 1;
  let inCell, nearest;
  const names = columnNames(header);
  names.forEach((name, column) => {
    const [origin, exponent, ...slopes] = header.rules[column];
    const k = /^[xy]\d+$/.test(name) ? Number(name.slice(1)) : -1, axis = ["x0", "y0", "time"].indexOf(name);
    const has = k > 0 ? (i) => q.degree[i] >= k : () => true;
    const halves = new Int32Array(num), steps = new Float64Array(num).fill(1), from = new Float64Array(num);
    if (!WHOLE.includes(name))
      for (let i = 0; i < num; i++) {
        let total = exponent;
        for (let j = 0; j < slopes.length; j++) total = total + slopes[j] * features[j][i];
        halves[i] = clip(Math.floor(2 * total + 0.5), FINEST, FARTHEST);
        const step = power(halves[i]);
        steps[i] = name in WIDEST ? Math.min(step, WIDEST[name]) : step;
        from[i] = origin;
        if (axis >= 0 && cells[axis] > 0) {
          const index = along(q.cell[i], cells, axis);
          const center = middles[axis] + ((index + 0.5) / 2 ** cells[axis] - 0.5) * sides[axis];
          from[i] = Math.floor(center / steps[i] + 0.5) * steps[i];
        }
      }
    const contexts = (i) => {
      const first = (halves[i] >> 1) & 31, own = name === "class" ? 0 : q.class[i] & 31;
      if (k > 0) {
        const top = first + (q.degree[i] === k ? 32 : 0), size = (other) => magnitudeClass(Math.abs(q[other][i]));
        const low = k > 1 ? size(name[0] + (k - 1)) : q.degree[i];
        const high = name[0] === "y" ? size("x" + k) : k > 1 ? size("y" + (k - 1)) : q.degree[i];
        return [top, 16 * high + low];
      }
      if (name === "blue") return [first, 16 * magnitudeClass(Math.abs(q.luma[i]))];
      if (name === "green") return [first, 16 * magnitudeClass(Math.abs(q.luma[i])) + magnitudeClass(Math.abs(q.blue[i]))];
      return [first, own];
    };
    let known = { ...emptyColumn(num), origin: (i) => from[i], step: (i) => steps[i] };
    if (name !== "cell") {
      const near = k > 0 || ["angle", ...COLORS].includes(name) ? nearest : inCell;
      const scale = k > 0 ? (i) => { let s = half[i]; for (let n = 1; n < k; n++) s = s * half[i]; return s; } : one;
      known = { ...known, has, contexts, scale, near, width: NEIGHBORS };
    }
    const numbers = decodeColumn(streams[column], known);
    onColumn((column + 1) / names.length);
    if (name in most && numbers.some((own) => own < 0 || own > most[name])) throw new Error(DAMAGED);
    if (name === "cell") {
      let here = 0;
      for (let i = 0; i < num; i++) numbers[i] = here = (here + numbers[i]) & (2 ** (cells[0] + cells[1] + cells[2]) - 1);
      inCell = findLatestInCell(numbers, 2 ** (cells[0] + cells[1] + cells[2]));
    }
    q[name] = numbers;
    const value = (v[name] = new Float64Array(num));
    for (let i = 0; i < num; i++) value[i] = has(i) ? from[i] + numbers[i] * steps[i] : 0;
    if (FEATURES.includes(name)) features.push(value);
    if (name === "y0") {
      const middle = new Float64Array(num);
      for (let i = 0; i < num; i++) [middle[i], half[i]] = spanOf(inClip(v.time[i]), v.duration[i], header.reach);
      const side = paths ? Math.max(...paths.sides) : 1, across = (own, axis) => own.map((x) => (x - middles[axis]) / side);
      nearest = findNearest(across(v.x0, 0), across(v.y0, 1), middle.map((own) => (TIME * own) / side), Math.max(cells[0], cells[1]) + 1);
    }
  });
  return v;
}

/** Shared paths: the times of their knots, and their maps. */
function decodePaths({ paths }, [knotBytes, mapBytes], logits) {
  const { num_paths: num, num_knots: knots, bits } = paths, total = num * knots;
  const times = new Float32Array(total), matrices = new Float32Array(6 * total);
  const before = (i, width) => (Math.floor(i / width) % knots > 0 ? i - width : -1);
  if (paths.at_frames) {
    const largest = logits.reduce((a, b) => Math.max(a, b), -Infinity), sums = [0];
    for (const own of logits) sums.push(sums.at(-1) + exp(own - largest));
    for (let i = 0; i < total; i++) times[i] = i % knots ? sums[i % knots] / sums.at(-1) : 0;
  } else {
    const numbers = Array.from(decodeColumn(knotBytes, emptyColumn(total)));
    for (let i = 0; i < total; i++) times[i] = (numbers[i] += numbers[before(i, 1)] ?? 0) * 2 ** -24;
  }
  const near = Int32Array.from({ length: 6 * total }, (_, i) => before(i, 6)), contexts = (i) => [i % 6, 0];
  const numbers = Array.from(decodeColumn(mapBytes, { ...emptyColumn(6 * total), contexts, near, width: 1 }));
  for (let i = 0; i < 6 * total; i++)
    matrices[i] = (numbers[i] += numbers[near[i]] ?? (i % 6 === 0 || i % 6 === 4 ? 2 ** bits : 0)) * 2 ** -bits;
  return { path_times: times, path_matrices: matrices };
}

const CRC = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; k++) n = n & 1 ? (n >>> 1) ^ 0xedb88320 : n >>> 1;
  return n;
});

function crc32(bytes) {
  let sum = 0xffffffff;
  for (let k = 0; k < bytes.length; k++) sum = CRC[(sum ^ bytes[k]) & 255] ^ (sum >>> 8);
  return (sum ^ 0xffffffff) >>> 0;
}

/** The number of bytes up to the end of the header, from the first 20. Throws an Error for another file. */
export function headerBytes(bytes) {
  if (bytes.length < FIXED || MAGIC.some((own, k) => bytes[k] !== own)) throw new Error("This is not a compact model, or one that a transfer has damaged.");
  const fixed = new DataView(bytes.buffer, bytes.byteOffset), version = fixed.getUint32(8, true);
  if (version !== VERSION) throw new Error(`This compact model has version ${version}; the page reads version ${VERSION}. ${version < VERSION ? "Compress the model again." : "Write the page with the newer foldgauss."}`);
  return FIXED + fixed.getUint32(12, true);
}

/**
 * The header, from the bytes up to its end. Added are `num_gaussians` of all chunks; to motion and chunks `start` and
 * `stop`, their bytes in the file; and to chunks `first`, the number in the model of their first Gaussian.
 */
export function readHeader(bytes) {
  const end = headerBytes(bytes), text = bytes.subarray(FIXED, end);
  const sum = new DataView(bytes.buffer, bytes.byteOffset).getUint32(16, true);
  if (bytes.length < end || crc32(text) !== sum) throw new Error(DAMAGED);
  const header = JSON.parse(new TextDecoder().decode(text)), { degree, num_frames: frames, paths, motion, chunks } = header;
  const blocks = [motion, ...chunks], whole = [degree, frames, ...chunks.map((own) => own.num_gaussians), ...blocks.flatMap((own) => own.streams)];
  const areCounts = whole.every((own) => Number.isSafeInteger(own) && own >= 0);
  if (!(areCounts && degree <= MOST_DEGREE && chunks.length > 0 && chunks.length <= MOST_CHUNKS)) throw new Error(DAMAGED);
  let at = end, first = 0;
  for (const own of blocks) [own.start, own.stop] = [at, (at += own.streams.reduce((all, one) => all + one, 0))];
  for (const own of [...chunks].reverse()) [own.first, first] = [first, first + own.num_gaussians];
  const ofPaths = paths ? paths.num_paths * paths.num_knots * (paths.at_frames ? 6 : 7) : 0, { length } = columnNames(header);
  const counts = [frames + ofPaths, ...chunks.map((own) => own.num_gaussians * length)];
  const lacking = blocks.reduce((sum, { start, stop }, k) => sum + Math.max(Math.ceil(counts[k] / MOST_PER_BYTE) - (stop - start), 0), 0);
  if (lacking > end - FIXED || counts.includes(0) || !chunks.every(haveRoom)) throw new Error(DAMAGED);
  return Object.assign(header, { num_gaussians: first });
}

/** Whether a chunk has no more cells than Gaussians. */
function haveRoom({ cells: [x, y, time], num_gaussians: num }) {
  return x + y + time <= MOST_CELL_BITS && 2 ** Math.max(x + y + time, 2 * x, 2 * y) <= num;
}

/** The streams of a block, from its bytes. */
function streamsOf(block, bytes) {
  if (bytes.length !== block.stop - block.start || crc32(bytes) !== block.crc) throw new Error(DAMAGED);
  let at = 0;
  return block.streams.map((length) => bytes.subarray(at, (at += length)));
}

/** The leaves that all chunks share, from the bytes of the block of motion: see `decode`. */
export function decodeMotion(header, bytes) {
  const [times, ...ofPaths] = streamsOf(header.motion, bytes), step = 2 ** -header.time_bits;
  const logits = Float64Array.from(decodeColumn(times, emptyColumn(header.num_frames - 1)), (q) => q * step);
  return withoutNegativeZeros({ frame_times: Float32Array.from(logits), ...(header.paths ? decodePaths(header, ofPaths, logits) : {}) });
}

/** Leaves of `num` Gaussians. */
function makeLeaves({ degree, paths }, num) {
  const names = Object.keys(WIDTHS).filter((name) => paths || name !== "path_index");
  return Object.fromEntries(names.map((name) => [name, new (name === "path_index" ? Uint8Array : Float32Array)(num * WIDTHS[name](degree))]));
}

/** Leaves of all of a model's Gaussians before any has arrived: each is there at the end of the clip for no time, and without opacity. */
export function emptyLeaves(header) {
  const leaves = makeLeaves(header, header.num_gaussians);
  leaves.time_loc_logit.fill(1000);
  leaves.log_time_scale.fill(-1000);
  leaves.opacity_logit.fill(-1000);
  return leaves;
}

/**
 * {header, leaves, lost}: the file's header, and Float32Arrays named and laid out as in FoldedSplats, and frame_times;
 * with shared paths, `path_index` (Uint8Array), `path_times` and `path_matrices`, too. `lost`: the chunks that are damaged
 * or missing. Their Gaussians are invisible, see `emptyLeaves`. `onColumn` is called with the fraction of columns decoded.
 */
export function decode(buffer, onColumn = () => {}) {
  const bytes = new Uint8Array(buffer), header = readHeader(bytes), { motion, chunks, degree } = header, lost = [];
  const leaves = { ...emptyLeaves(header), ...decodeMotion(header, bytes.subarray(motion.start, motion.stop)) };
  chunks.forEach((chunk, number) => {
    try {
      const part = decodeChunk(header, chunk, bytes.subarray(chunk.start, chunk.stop), (fraction) => onColumn((number + fraction) / chunks.length));
      for (const [name, own] of Object.entries(part)) leaves[name].set(own, chunk.first * WIDTHS[name](degree));
    } catch {
      lost.push(number);
    }
  });
  if (lost.length === chunks.length) throw new Error(DAMAGED);
  return { header, leaves, lost };
}

/** The leaves of a chunk's Gaussians, from its bytes. Throws an Error if it is damaged. */
export function decodeChunk(header, chunk, bytes, onColumn = () => {}) {
  const num = chunk.num_gaussians, { degree } = header, v = decodeColumns(header, chunk, streamsOf(chunk, bytes), onColumn);
  const leaves = makeLeaves(header, num);
  leaves.path_index?.set(v.path);
  const table = legendre(degree), powers = new Float64Array(degree + 1);
  for (let i = 0; i < num; i++) {
    const time = inClip(v.time[i]);
    leaves.log_scale[2 * i] = v.size[i] + v.stretch[i];
    leaves.log_scale[2 * i + 1] = v.size[i] - v.stretch[i];
    leaves.angle_logit[i] = logit(inClip(v.angle[i]));
    leaves.time_loc_logit[i] = logit(time);
    leaves.log_time_scale[i] = v.duration[i];
    leaves.opacity_logit[i] = v.opacity[i];
    for (let c = 0; c < 3; c++)
      leaves.color_dc[3 * i + c] = v.luma[i] * AXES[0][c] + v.blue[i] * AXES[1][c] + v.green[i] * AXES[2][c];
    // The path: a Legendre series in w = (t - middle) / half, as powers of u = m_t - t.
    const [middle, half] = spanOf(time, v.duration[i], header.reach);
    const at = (time - middle) / half, scale = -1 / half;
    for (let axis = 0; axis < 2; axis++) {
      for (let j = 0; j <= degree; j++) {
        powers[j] = 0;
        for (let k = j; k <= degree; k += 2) powers[j] = powers[j] + table[k][j] * v["xy"[axis] + k][i];
      }
      for (let j = 0; j < degree; j++) for (let k = degree - 1; k >= j; k--) powers[k] = powers[k] + at * powers[k + 1];
      let factor = 1;
      for (let k = 0; k <= degree; k++) {
        if (k === 0) leaves.loc[2 * i + axis] = powers[0] * factor;
        else leaves.coefficients[2 * (degree * i + k - 1) + axis] = powers[k] * factor;
        factor = factor * scale;
      }
    }
  }
  return withoutNegativeZeros(leaves);
}

function withoutNegativeZeros(leaves) {
  for (const leaf of Object.values(leaves)) for (let k = 0; k < leaf.length; k++) leaf[k] = leaf[k] + 0;
  return leaves;
}
