// PLY files of the published VeGaS code: the twin of foldgauss.io.exchange.vegas_ply.read_vegas_ply, where the formulas are.
export const FIELD_OF_VIEW = 0.6911112; // radians, of the front camera
const POWER = 2, SCALE_CUTOFF = 1e-4; // of the published code
export const OPTIONS = { low_pass: 0.3, alpha_cutoff: 1 / 255, alpha_ceiling: 0.99, transmittance_stop: 1e-4, tile_size: null, list_capacity: null, support_radius: null };

/** {header, leaves} of what `readPly` gives. `given`: {size, fps}, which files of the published code lack: an Error says so by `missing`. */
export function readVegas({ elements: { vertex, time }, note }, given) {
  if (!vertex.sigma_0 || !vertex.rot_0 || !time) throw new Error("This video of VeGaS has no sigma_0, rot_0 or element time. It is damaged: copy it again.");
  const size = note.size ?? given.size, fps = note.fps ?? given.fps;
  if (!size || !fps) throw Object.assign(new Error("A VeGaS file holds neither the size nor the rate of its video."), { missing: true });
  const [height, width] = size, unit = Math.min(1, width / height) / (2 * Math.tan(FIELD_OF_VIEW / 2)), num = vertex.x.length;
  const degree = Object.keys(vertex).filter((name) => name.startsWith("w1_")).length >> 1, power = note.power ?? POWER;
  const pairs = (one, other, map) => Float32Array.from({ length: 2 * num }, (_, k) => map(k % 2 ? other[k >> 1] : one[k >> 1], k % 2));
  const mapped = (own, second) => (second ? -unit : unit) * own;
  const coefficients = new Float32Array(2 * degree * num), color = new Float32Array(3 * num);
  for (let i = 0; i < num; i++) {
    for (let k = 0; k < 2 * degree; k++) coefficients[2 * degree * i + k] = mapped(vertex[`w1_${k}`][i], k % 2);
    for (let c = 0; c < 3; c++) color[3 * i + c] = vertex[`f_dc_${c}`][i];
  }
  const leaves = {
    loc: pairs(vertex.x, vertex.z, mapped), log_scale: pairs(vertex.scale_0, vertex.scale_2, (own) => own + Math.log(unit)),
    angle_logit: Float32Array.from(vertex.rot_0), time_loc_logit: Float32Array.from(vertex.m_0),
    log_time_scale: Float32Array.from(vertex.sigma_0, (own) => own + 0.5 * Math.log(power / POWER)),
    coefficients, opacity_logit: Float32Array.from(vertex.opacity), color_dc: color, frame_times: Float32Array.from(weightsOf(time)),
  };
  const header = {
    num_gaussians: num, degree, power, floor: 0, num_frames: leaves.frame_times.length + 1, size, fps, options: note.options ?? OPTIONS,
    compositing: "over", scale_cutoff: note.scale_cutoff ?? SCALE_CUTOFF * unit,
  };
  return { header, leaves };
}

/** Weights of the frame times: columns of one row, or rows of one column. */
function weightsOf(time) {
  const names = Object.keys(time).sort((a, b) => a.length - b.length || (a < b ? -1 : 1));
  return names.length === 1 ? time[names[0]] : names.map((name) => time[name][0]);
}
