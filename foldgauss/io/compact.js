// Decoder of compact model files (.fgz): see docs/format.md. The same bits as foldgauss.video.quantise.dequantise, whose
// operations it repeats in their order. Runs in browsers and elsewhere; no dependency.

const FEATURES = ["class", "size", "stretch", "duration", "opacity"];
const FIRST = [...FEATURES, "time", "angle", "luma", "blue", "green"];
const AXES = [
  [0.5773502691896258, 0.5773502691896258, 0.5773502691896258],
  [-0.7071067811865476, 0.0, 0.7071067811865476],
  [-0.408248290463863, 0.8164965809277261, -0.408248290463863],
];
const WIDEST = { time: 0.125, angle: 0.125, size: 0.35, stretch: 0.5, duration: 0.5, opacity: 1.0 };
const MAGIC = [0x8b, 0x46, 0x47, 0x5a, 0x0d, 0x0a, 0x1a, 0x0a];
const NODES = 130, CONTEXTS = 32, MEMORY = 400, LARGEST_BITS = 30, FARTHEST = 120;
const LN2 = 0.6931471805599453, SQRT2 = 1.4142135623730951;

/** A column's numbers, Int32Array, from its bytes and the contexts (Uint8Array). */
export function decodeColumn(data, contexts) {
  const share = new Int32Array(CONTEXTS * NODES).fill(32768), count = new Int32Array(CONTEXTS * NODES).fill(2);
  let low = 0, high = 0xffffffff, code = 0, next = 0;
  const byte = () => (next < data.length ? data[next++] : (next++, 0));
  for (let k = 0; k < 4; k++) code = ((code << 8) | byte()) >>> 0;
  const bit = (p) => {
    const span = high - low, middle = low + (span >>> 16) * p + (((span & 0xffff) * p) >>> 16);
    const one = code <= middle;
    if (one) high = middle; else low = middle + 1;
    while (((low ^ high) & 0xff000000) === 0) {
      low = (low << 8) >>> 0;
      high = ((high << 8) | 255) >>> 0;
      code = ((code << 8) | byte()) >>> 0;
    }
    return one;
  };
  const learned = (node) => {
    const p = share[node], n = count[node], one = bit(p);
    share[node] = one ? p + Math.floor((65536 - p) / n) : p - Math.floor(p / n);
    if (n < MEMORY) count[node] = n + 1;
    return one;
  };
  const values = new Int32Array(contexts.length);
  for (let k = 0; k < values.length; k++) {
    const base = contexts[k] * NODES;
    if (learned(base)) continue;
    const negative = learned(base + 1);
    let exponent = 0;
    while (learned(base + 2 + exponent)) if (++exponent >= LARGEST_BITS) throw new Error("a column is damaged");
    let magnitude = 1, leading = 1;
    for (let b = 0; b < exponent; b++) {
      let own;
      if (leading < 4) {
        own = learned(base + 34 + 3 * exponent + leading - 1) ? 1 : 0;
        leading = 2 * leading + own;
      } else own = bit(32768) ? 1 : 0;
      magnitude = 2 * magnitude + own;
    }
    values[k] = negative ? -magnitude : magnitude;
  }
  if (next !== data.length + 3) throw new Error("a column is damaged");
  return values;
}

const clip = (x, low, high) => Math.min(Math.max(x, low), high);

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
const inClip = (x) => Math.min(Math.max(x, 2 ** -24), 1 - 2 ** -24);

function legendre(degree) {
  const comb = (n, k) => { let c = 1; for (let j = 1; j <= k; j++) c = (c * (n - k + j)) / j; return c; };
  return Array.from({ length: degree + 1 }, (_, k) => {
    const row = new Float64Array(degree + 1);
    for (let j = 0; 2 * j <= k; j++) row[k - 2 * j] = ((j % 2 ? -1 : 1) * comb(k, j) * comb(2 * k - 2 * j, k)) / 2 ** k;
    return row;
  });
}

/** {header, leaves}: the file's header, and Float32Arrays named and laid out as in FoldedSplats, and frame_times. */
export function decode(buffer) {
  const bytes = new Uint8Array(buffer), fixed = new DataView(buffer);
  if (bytes.length < 20 || MAGIC.some((own, k) => bytes[k] !== own)) throw new Error("not a compact model");
  if (fixed.getUint32(8, true) !== 1) throw new Error("a compact model of another version");
  let start = 20 + fixed.getUint32(12, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.subarray(20, start)));
  const num = header.num_gaussians, degree = header.degree, v = {}, features = [];
  const stream = (length) => bytes.subarray(start, (start += length));
  for (const { name, bytes: length, origin, exponent, slopes } of header.columns) {
    const halves = new Int32Array(num), contexts = new Uint8Array(num), value = (v[name] = new Float64Array(num));
    for (let i = 0; i < num; i++) {
      let total = exponent;
      for (let j = 0; j < slopes.length; j++) total = total + slopes[j] * features[j][i];
      halves[i] = clip(Math.floor(2 * total + 0.5), -FARTHEST, FARTHEST);
      contexts[i] = (halves[i] >> 1) & (CONTEXTS - 1);
    }
    const numbers = decodeColumn(stream(length), contexts);
    for (let i = 0; i < num; i++) {
      const step = power(halves[i]);
      value[i] = origin + numbers[i] * (name in WIDEST ? Math.min(step, WIDEST[name]) : step);
    }
    if (FEATURES.includes(name)) features.push(value);
  }
  const intervals = decodeColumn(stream(header.intervals), new Uint8Array(header.num_frames - 1));
  const leaves = {
    loc: new Float32Array(2 * num), log_scale: new Float32Array(2 * num), angle_logit: new Float32Array(num),
    time_loc_logit: new Float32Array(num), log_time_scale: new Float32Array(num),
    coefficients: new Float32Array(2 * num * degree), opacity_logit: new Float32Array(num),
    color_dc: new Float32Array(3 * num), frame_times: Float32Array.from(intervals, (q) => q * 2 ** -10),
  };
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
    const halves = clip(Math.floor(2 * (v.duration[i] * (1 / LN2)) + 0.5), -FARTHEST, FARTHEST);
    const wide = header.reach * power(halves);
    const first = Math.max(time - wide, 0), last = Math.min(time + wide, 1);
    const middle = (first + last) * 0.5, half = Math.max((last - first) * 0.5, 2 ** -40);
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
  return { header, leaves };
}
