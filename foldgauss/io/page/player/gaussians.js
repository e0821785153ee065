// A decoded model prepare for rendering: activated parameters in texels of four, and the time windows of Gaussians.
import { decode } from "./compact.js";
import { frameTimes } from "./timeline.js";

export const TEXTURE_WIDTH = 2048;
const SH_C0 = 0.28209479177387814;
const TAU_MAX = Math.sqrt(-2 * Math.log(0.01)); // beyond, a Gaussian is not rendered

const sigmoid = (x) => 1 / (1 + Math.exp(-x));

/**
 * Prepare a compact file's model. Texels of a Gaussian:
 * 0: m_s, m_t, sigma_t; 1: two standard deviations, cosine and sine of the first one's angle;
 * 2: red, green, blue, opacity; 3 and on: the path's coefficients, two powers each.
 */
export function prepare(buffer, onProgress) {
  const { header, leaves } = decode(buffer, onProgress);
  const num = header.num_gaussians, degree = header.degree, texels = 3 + Math.ceil(degree / 2), width = 4 * texels;
  const rows = Math.ceil((num * texels) / TEXTURE_WIDTH);
  const values = new Float32Array(4 * TEXTURE_WIDTH * rows);
  for (let i = 0; i < num; i++) {
    const at = i * width, angle = 2 * Math.PI * sigmoid(leaves.angle_logit[i]);
    const color = [0, 1, 2].map((c) => Math.max(0.5 + SH_C0 * leaves.color_dc[3 * i + c], 0));
    values.set(
      [
        leaves.loc[2 * i], leaves.loc[2 * i + 1], sigmoid(leaves.time_loc_logit[i]), Math.exp(leaves.log_time_scale[i]),
        Math.exp(leaves.log_scale[2 * i]), Math.exp(leaves.log_scale[2 * i + 1]), Math.cos(angle), Math.sin(angle),
        ...color, sigmoid(leaves.opacity_logit[i]),
      ],
      at,
    );
    for (let k = 0; k < 2 * degree; k++) values[at + 12 + k] = leaves.coefficients[2 * degree * i + k];
  }
  const times = frameTimes(leaves.frame_times);
  return { header, num, degree, texels, rows, values, times, windows: windows(header, num, width, values) };
}

/** Time windows in which Gaussians are rendered: near m_t, and above the file's scale cutoff. */
function windows(header, num, width, values) {
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
