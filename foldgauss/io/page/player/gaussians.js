// A model's Gaussians: their parameters, and what the shader reads of them, texels of four floats and windows of time.
import { mapsAt, pathsOf } from "./paths.js";
import { frameTimes } from "./timeline.js";

export const TEXTURE_WIDTH = 2048;
export const SH_C0 = 0.28209479177387814;
const ENDLESS = 1e30; // a time before or after all others
const TAU_MAX = Math.sqrt(-2 * Math.log(0.01)); // beyond, a Gaussian is not rendered
/** log sigma_t of Gaussians that stand still throughout the clip. */
export const STATIC = Math.fround(Math.log(1024));

export const sigmoid = (x) => 1 / (1 + Math.exp(-x));

/** Numbers per Gaussian of each leaf; `coefficients` has two per power; only a model with shared paths has `path_index`. `held`: see `prepare`. */
export const WIDTHS = {
  loc: () => 2, log_scale: () => 2, angle_logit: () => 1, time_loc: () => 1, log_time_scale: () => 1,
  coefficients: (degree) => 2 * degree, opacity_logit: () => 1, color_dc: () => 3, path_index: () => 1, held: () => 2,
};

/**
 * Prepare a model for rendering and editing from a file's header and leaves, named and laid out as in FoldedSplats.
 *
 * Its `leaves` hold m_t itself, `time_loc` in double precision, since an edit may move it out of the clip, and `held`,
 * the first and the last time at which a Gaussian moves: before and after it stands still. Texels of a Gaussian: 0: m_s,
 * m_t, sigma_t; 1: two standard deviations, cosine and sine of the first one's angle; 2: red, green, blue, opacity; 3 and
 * on: the path's coefficients, two powers each; the last one: the number of its shared path, and `held`.
 */
export function prepare({ header, leaves: { frame_times: intervals, path_times, path_matrices, ...own } }) {
  const num = header.num_gaussians, { degree } = header, texels = texelsOf(degree), rows = Math.ceil((num * texels) / TEXTURE_WIDTH);
  const paths = pathsOf(header, { path_times, path_matrices }), times = frameTimes(intervals);
  return { header, num, degree, texels, rows, times, paths, intervals, ...prepareRows(header, own, num, 4 * TEXTURE_WIDTH * rows) };
}

const texelsOf = (degree) => 4 + Math.ceil(degree / 2);

/** What `prepare` makes of the leaves of some Gaussians: their leaves, windows of time, and `length` values, their texels. */
export function prepareRows(header, { time_loc_logit: logits, path_index, ...rest }, num, length = 4 * num * texelsOf(header.degree)) {
  const texels = texelsOf(header.degree), values = new Float32Array(length);
  const leaves = { ...rest, time_loc: Float64Array.from(logits, sigmoid), held: Float32Array.from({ length: 2 * num }, (_, k) => (k % 2 ? ENDLESS : -ENDLESS)) };
  if (header.paths) leaves.path_index = Uint32Array.from(path_index);
  for (let i = 0; i < num; i++) fillTexels(values, i, leaves, texels, header.degree);
  return { values, windows: makeWindows(header, num, 4 * texels, values), leaves };
}

/** Put a part, {first, ...} of `prepareRows`, into a model: its Gaussians from number `first` on. */
export function place({ degree, texels, values, windows, leaves }, part) {
  values.set(part.values, 4 * texels * part.first);
  windows.set(part.windows, 2 * part.first);
  for (const [name, own] of Object.entries(part.leaves)) leaves[name].set(own, WIDTHS[name](degree) * part.first);
}

/** Write the texels of Gaussian `i`. */
export function fillTexels(values, i, leaves, texels, degree) {
  const at = 4 * texels * i, angle = 2 * Math.PI * sigmoid(leaves.angle_logit[i]);
  values[at] = leaves.loc[2 * i];
  values[at + 1] = leaves.loc[2 * i + 1];
  values[at + 2] = leaves.time_loc[i];
  values[at + 3] = Math.exp(leaves.log_time_scale[i]);
  values[at + 4] = Math.exp(leaves.log_scale[2 * i]);
  values[at + 5] = Math.exp(leaves.log_scale[2 * i + 1]);
  values[at + 6] = Math.cos(angle);
  values[at + 7] = Math.sin(angle);
  for (let c = 0; c < 3; c++) values[at + 8 + c] = Math.max(0.5 + SH_C0 * leaves.color_dc[3 * i + c], 0);
  values[at + 11] = sigmoid(leaves.opacity_logit[i]);
  for (let k = 0; k < 2 * degree; k++) values[at + 12 + k] = leaves.coefficients[2 * degree * i + k];
  values.set([leaves.path_index?.[i] ?? 0, leaves.held[2 * i], leaves.held[2 * i + 1]], at + 4 * texels - 4);
}

/** Time windows in which Gaussians are rendered: near m_t, and above the file's scale cutoff. */
function makeWindows(header, num, width, values) {
  const { power, floor, scale_cutoff: thinnest } = header, spans = new Float32Array(2 * num);
  for (let i = 0; i < num; i++) {
    const own = values[i * width + 2], duration = values[i * width + 3];
    let reach = TAU_MAX;
    if (thinnest > 0) {
      const smaller = Math.min(values[i * width + 4], values[i * width + 5]);
      const needed = (thinnest / smaller) ** 2 - floor; // (1 - floor) exp(-power tau^2 / 2) must exceed it
      if (needed >= 1 - floor) reach = 0;
      else if (needed > 0) reach = Math.min(reach, Math.sqrt((2 * Math.log((1 - floor) / needed)) / power));
    }
    spans[2 * i] = own - reach * duration;
    spans[2 * i + 1] = own + reach * duration;
  }
  return spans;
}

/** A short name of a model by its values, for what the browser keeps: FNV-1a over their bits. */
export function fingerprintOf({ values, num }) {
  const words = new Uint32Array(values.buffer);
  let sum = 0x811c9dc5, other = num;
  for (let k = 0; k < words.length; k++) {
    sum = Math.imul(sum ^ words[k], 0x01000193);
    other = (Math.imul(other, 31) + sum) | 0; // 32 bits more
  }
  return [sum, other].map((own) => (own >>> 0).toString(16).padStart(8, "0")).join("");
}

/** A Gaussian conditioned on a time: center, variances along its axes with the low-pass filter's added, axes. Model units. */
export function condition(model, i, time, lowPass) {
  const { values, texels, degree, header } = model, at = 4 * texels * i, last = at + 4 * texels - 4;
  const u = values[at + 2] - Math.min(Math.max(time, values[last + 1]), values[last + 2]), tau = u / values[at + 3];
  const a = header.floor + (1 - header.floor) * Math.exp(-0.5 * header.power * tau * tau);
  let x = 0, y = 0;
  for (let k = 2 * degree - 2; k >= 0; k -= 2) {
    x = u * (x + values[at + 12 + k]);
    y = u * (y + values[at + 13 + k]);
  }
  const own = {
    i, a, x: values[at] + x, y: values[at + 1] + y,
    first: values[at + 4] ** 2 * a + lowPass, second: values[at + 5] ** 2 * a + lowPass,
    cos: values[at + 6], sin: values[at + 7], opacity: values[at + 11],
  };
  const path = values[last];
  return path ? moved(own, mapsAt(model.paths, time).subarray(6 * path, 6 * path + 6), lowPass) : own;
}

/** A conditioned Gaussian after the map (L | b) of its path. */
function moved(one, [a, b, right, c, d, down], lowPass) {
  const { x, y, cos, sin } = one, first = one.first - lowPass, second = one.second - lowPass;
  const along = [a * cos + b * sin, c * cos + d * sin], across = [b * cos - a * sin, d * cos - c * sin]; // the axes, mapped
  const xx = first * along[0] ** 2 + second * across[0] ** 2, yy = first * along[1] ** 2 + second * across[1] ** 2;
  const xy = first * along[0] * along[1] + second * across[0] * across[1], angle = 0.5 * Math.atan2(2 * xy, xx - yy);
  const longer = 0.5 * (xx + yy) + Math.hypot(0.5 * (xx - yy), xy), shorter = longer > 0 ? ((a * d - b * c) ** 2 * first * second) / longer : 0;
  return {
    ...one, x: a * x + b * y + right, y: c * x + d * y + down,
    first: longer + lowPass, second: shorter + lowPass, cos: Math.cos(angle), sin: Math.sin(angle),
  };
}

/** Its alpha at a point. */
export function alphaAt(one, x, y) {
  const dx = x - one.x, dy = y - one.y, along = one.cos * dx + one.sin * dy, across = one.cos * dy - one.sin * dx;
  return one.opacity * Math.exp(-0.5 * ((along * along) / one.first + (across * across) / one.second));
}

/** The indices of the Gaussians alive at a time, in order, written to `buffer`; returns the part that is used. */
export function alive(model, time, buffer) {
  const { num, windows } = model, t = Math.fround(time);
  let count = 0;
  for (let i = 0; i < num; i++) if (windows[2 * i] < t && t < windows[2 * i + 1]) buffer[count++] = i;
  return buffer.subarray(0, count);
}

/** The fit's low-pass filter as a variance in model units. */
export const lowPassOf = ({ options, size }) => options.low_pass / Math.max(...size) ** 2;
