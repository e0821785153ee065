// 3DGS scenes as still images: the twin of foldgauss.io.exchange.gaussians_ply.read_3dgs_ply, of foldgauss.render.project and
// of its front camera. Colors are those of degree 0, the mean over all directions.
import { STATIC } from "./gaussians.js";
import { angleLogit } from "./parameters.js";
import { FIELD_OF_VIEW, OPTIONS } from "./vegas.js";

const NEAR = 0.01, TANGENT_LIMIT = 1.3; // of foldgauss.render.project
const SMALLEST = 1e-20; // of a standard deviation, whose logarithm must be finite
const SIDE = 1280, LEAST_SIDE = 160; // pixels of the image of another program's scene
const BULK = 0.01; // of the Gaussians, left out at both ends of each axis
const COLUMNS = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
const ABOUT = "A 3DGS scene, shown as a still image along its z-axis. Colors that depend on the direction are left out.";

export const isScene = (vertex) => COLUMNS.every((name) => vertex?.[name]);

/** {header, leaves} of what `readPly` gives. A frame that foldgauss exported is seen as that frame was. */
export function readScene({ elements: { vertex }, note }) {
  const num = vertex.x.length, { size, middle, side } = note.size ? { size: note.size, middle: [0, 0, 0], side: 1 } : fit(vertex);
  const flip = note.axes === "y-up" ? -1 : 1, long = Math.max(...size);
  const distance = Math.min(1, size[1] / size[0]) / (2 * Math.tan(FIELD_OF_VIEW / 2)), limits = [size[1], size[0]].map((own) => (TANGENT_LIMIT * own) / (2 * long * distance));
  const depths = vertex.z.map((own) => (flip * own - middle[2]) / side + distance);
  const order = Uint32Array.from({ length: num }, (_, i) => i).filter((i) => depths[i] > NEAR).sort((one, other) => depths[one] - depths[other] || one - other);
  const count = order.length, leaves = {
    loc: new Float32Array(2 * count), log_scale: new Float32Array(2 * count), angle_logit: new Float32Array(count),
    time_loc_logit: new Float32Array(count), log_time_scale: new Float32Array(count).fill(STATIC), coefficients: new Float32Array(0),
    opacity_logit: Float32Array.from(order, (i) => vertex.opacity[i]), color_dc: new Float32Array(3 * count), frame_times: new Float32Array(0),
  };
  order.forEach((i, k) => {
    const away = depths[i], shrink = distance / away, place = [(vertex.x[i] - middle[0]) / side, (flip * vertex.y[i] - middle[1]) / side];
    const held = place.map((own, axis) => Math.min(Math.max(own / away, -limits[axis]), limits[axis])), [right, down, ahead] = axesOf(vertex, i, flip);
    const rows = [right, down].map((row, axis) => row.map((own, c) => ((own - held[axis] * ahead[c]) * shrink) / side)); // J W F
    const { first, second, angle } = ellipse(rows);
    for (const axis of [0, 1]) leaves.loc[2 * k + axis] = place[axis] * shrink;
    [leaves.log_scale[2 * k], leaves.log_scale[2 * k + 1]] = [Math.log(first), Math.log(second)];
    leaves.angle_logit[k] = angleLogit(angle);
    for (const c of [0, 1, 2]) leaves.color_dc[3 * k + c] = vertex[`f_dc_${c}`][i];
  });
  const header = {
    num_gaussians: count, degree: 0, power: 2, floor: 0, num_frames: 1, size, fps: 25, options: note.options ?? OPTIONS,
    compositing: "over", scale_cutoff: 0, about: note.size ? "" : ABOUT,
  };
  return { header, leaves };
}

/** The image of a scene of another program: what part of x and y it shows, the larger side as 1, and where z begins. */
function fit(vertex) {
  const ends = ["x", "y", "z"].map((name) => {
    const sorted = vertex[name].slice().sort(), last = sorted.length - 1;
    return [sorted[Math.floor(BULK * last)], sorted[Math.ceil((1 - BULK) * last)]];
  });
  const [width, height] = ends.map(([low, high]) => high - low), side = Math.max(width, height) || 1;
  const size = [height, width].map((own) => Math.max(Math.round((SIDE * own) / side), LEAST_SIDE));
  return { size, side, middle: [(ends[0][0] + ends[0][1]) / 2, (ends[1][0] + ends[1][1]) / 2, ends[2][0]] };
}

/** Rows of R S, of a rotation R by the quaternion (w, x, y, z) and standard deviations S; `flip`: y and z point the other way. */
function axesOf(vertex, i, flip) {
  const turn = [0, 1, 2, 3].map((k) => vertex[`rot_${k}`][i]), length = Math.hypot(...turn), [w, x, y, z] = turn.map((own) => own / length);
  const scale = [0, 1, 2].map((k) => Math.exp(vertex[`scale_${k}`][i])), signs = [1, flip, flip];
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ].map((row, r) => row.map((own, c) => signs[r] * own * scale[c]));
}

/** The standard deviations of M M^T along its axes, and the angle of the first: of two rows of three numbers. */
function ellipse([a, b]) {
  const dot = (one, other) => one[0] * other[0] + one[1] * other[1] + one[2] * other[2], xx = dot(a, a), xy = dot(a, b), yy = dot(b, b);
  const first = Math.max(Math.sqrt((xx + yy) / 2 + Math.hypot((xx - yy) / 2, xy)), SMALLEST);
  const area = Math.hypot(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]); // nothing cancels
  return { first, second: Math.max(area / first, SMALLEST), angle: 0.5 * Math.atan2(2 * xy, xx - yy) };
}
