// Edits as new parameters of the selected Gaussians: the twin of foldgauss.video.editing.bake, and of Recolor there.
import { SH_C0, STATIC, condition, sigmoid } from "./gaussians.js";
import { changedPaths, conjugated, mapsAt, retimed } from "./paths.js";
import { gathered, indicesOf, withChanged } from "./state.js";

const LUMINANCE = [0.2126, 0.7152, 0.0722];
const MIN_LIGHTNESS = 1e-4; // below, the lightness does not tell the shading of an object
const LARGEST_LOGIT = 16.6; // an opacity that float32 rounds to 1

const logit = (x) => Math.log(x) - Math.log1p(-x);
const dot = (one, other) => one.reduce((sum, own, k) => sum + own * other[k], 0);

/** m -> c + A (m - c) + b, of rows A, c `about`, b `offset`; shared paths go on in the frame that is moved. */
export function applyAffine(state, [[a, b], [c, d]], about, offset) {
  const { degree } = state.model, identity = a === 1 && b === 0 && c === 0 && d === 1;
  const names = identity ? ["loc"] : ["loc", "coefficients", "log_scale", "angle_logit"];
  const [right, down] = [offset[0] + (1 - a) * about[0] - b * about[1], offset[1] + (1 - d) * about[1] - c * about[0]];
  const paths = changedPaths(state, (path) => conjugated(path, [a, b, c, d], [right, down]));
  return withChanged(state, names, (leaves, i) => {
    const { loc, coefficients } = leaves;
    const x = loc[2 * i] - about[0], y = loc[2 * i + 1] - about[1];
    loc[2 * i] = a * x + b * y + about[0] + offset[0];
    loc[2 * i + 1] = c * x + d * y + about[1] + offset[1];
    if (identity) return;
    for (let k = 2 * degree * i; k < 2 * degree * (i + 1); k += 2) {
      const [along, across] = [coefficients[k], coefficients[k + 1]];
      coefficients[k] = a * along + b * across;
      coefficients[k + 1] = c * along + d * across;
    }
    mapAxes(leaves, i, [a, b, c, d]);
  }, paths);
}

/** Log standard deviations and angle of A R S: from the singular values of that matrix, two by two. */
function mapAxes({ log_scale: scale, angle_logit: angles }, i, [a, b, c, d]) {
  const angle = 2 * Math.PI * sigmoid(angles[i]), largest = Math.max(scale[2 * i], scale[2 * i + 1]); // so that no square overflows
  const first = Math.exp(scale[2 * i] - largest), second = Math.exp(scale[2 * i + 1] - largest);
  const cos = Math.cos(angle), sin = Math.sin(angle), determinant = a * d - b * c, stretch = Math.sqrt(Math.abs(determinant));
  const conformal = Math.max(Math.abs(a * a + b * b - stretch ** 2), Math.abs(c * c + d * d - stretch ** 2), Math.abs(a * c + b * d));
  if (determinant > 0 && conformal <= 1e-14 * stretch ** 2) { // a similarity: the axes stay axes
    scale[2 * i] += Math.log(stretch);
    scale[2 * i + 1] += Math.log(stretch);
    angles[i] = angleLogit(angle + Math.atan2(c, a));
    return;
  }
  const sum = scale[2 * i] + scale[2 * i + 1], p = (a * cos + b * sin) * first, q = (b * cos - a * sin) * second;
  const r = (c * cos + d * sin) * first, s = (d * cos - c * sin) * second;
  const xx = p * p + q * q, xy = p * r + q * s, yy = r * r + s * s; // the covariance
  scale[2 * i] = 0.5 * Math.log(0.5 * (xx + yy) + Math.hypot(0.5 * (xx - yy), xy)) + largest;
  scale[2 * i + 1] = Math.log(Math.abs(determinant)) + sum - scale[2 * i]; // from the determinant: nothing cancels
  angles[i] = angleLogit(0.5 * Math.atan2(2 * xy, xx - yy));
}

/** The angle is defined modulo pi; in [pi/2, 3 pi/2) its logit is best conditioned. */
export function angleLogit(angle) {
  const turned = angle - Math.PI / 2;
  return logit((turned - Math.PI * Math.floor(turned / Math.PI) + Math.PI / 2) / (2 * Math.PI));
}

/** Opacity times a factor, held at 1. */
export function applyOpacity(state, factor) {
  return withChanged(state, ["opacity_logit"], ({ opacity_logit: raw }, i) => {
    const odds = (1 - factor + Math.exp(-raw[i])) / factor; // loses no digits near opacity 1
    raw[i] = odds > 0 ? Math.min(-Math.log(odds), LARGEST_LOGIT) : LARGEST_LOGIT;
  });
}

/** Map the colors, red, green and blue, by a function. */
export function applyColors(state, map) {
  return withChanged(state, ["color_dc"], ({ color_dc: raw }, i) => {
    const color = map([0, 1, 2].map((c) => Math.max(0.5 + SH_C0 * raw[3 * i + c], 0)));
    color.forEach((own, c) => (raw[3 * i + c] = (Math.max(own, 0) - 0.5) / SH_C0));
  });
}

/** A color with another hue, in turns; its lightness and distance from gray are kept. */
export function withHue(hue) {
  const wrapped = (x) => x - Math.floor(x);
  const pure = [0, 2 / 3, 1 / 3].map((own) => Math.min(Math.max(Math.abs(wrapped(hue + own) * 6 - 3) - 1, 0), 1));
  const direction = pure.map((own) => own - dot(pure, LUMINANCE)), length = Math.hypot(...direction);
  return (color) => {
    const gray = dot(color, LUMINANCE), away = Math.hypot(...color.map((own) => own - gray));
    return direction.map((own) => gray + (away * own) / length);
  };
}

/** `color` times a color's lightness over the mean of the selections of several states, weighted by opacity. */
export function withColor(states, color) {
  let weighted = 0, total = 0;
  for (const state of states)
    for (const i of indicesOf(state)) {
      const { color_dc: raw, opacity_logit: logits } = state.model.leaves, opacity = sigmoid(logits[i]);
      weighted += opacity * dot([0, 1, 2].map((c) => Math.max(0.5 + SH_C0 * raw[3 * i + c], 0)), LUMINANCE);
      total += opacity;
    }
  if (!(weighted > MIN_LIGHTNESS * total)) throw new Error("color: expected an object that is not black, which has no shading to keep. Use offset.");
  return (own) => color.map((one) => (one * dot(own, LUMINANCE) * total) / weighted);
}

/**
 * Show time t of [0, 1] at about + shift + stretch (t - about); before and after, the selection stands still. Of
 * Gaussians that stand still already only the shared path has times.
 */
export function applyRetiming(state, shift, stretch, about) {
  const { degree } = state.model, windows = state.model.windows.slice(), moved = (t) => about + shift + stretch * (t - about);
  const after = withChanged(state, ["time_loc", "log_time_scale", "coefficients", "held"], (leaves, i) => {
    if (isStatic(leaves, i)) return;
    leaves.time_loc[i] = moved(leaves.time_loc[i]);
    leaves.log_time_scale[i] += Math.log(Math.abs(stretch));
    for (let k = 0; k < 2 * degree; k++) leaves.coefficients[2 * degree * i + k] /= stretch ** (1 + (k >> 1));
    const own = [2 * i, 2 * i + 1], [from, to] = own.map((k) => windows[k]);
    const held = [0, 1].map((t) => Math.min(Math.max(t, leaves.held[2 * i]), leaves.held[2 * i + 1]));
    const isSeen = from < held[1] && to > held[0]; // where it stands still it stays alive, or dead
    const seen = isSeen ? [from < held[0] ? -Infinity : from, to > held[1] ? Infinity : to] : [0, 0];
    for (const [into, times] of [[leaves.held, held], [windows, seen]]) times.map(moved).sort((one, other) => one - other).forEach((t, k) => (into[own[k]] = t));
  }, changedPaths(state, (path) => retimed(path, moved)));
  return { ...after, model: { ...after.model, windows } };
}

const isStatic = (leaves, i) => leaves.log_time_scale[i] === STATIC;

/** Hold the selected Gaussians as they are at a time: those alive then stand still throughout, the others are removed. */
export function applyFreeze(state, time) {
  const t = Math.fround(time), { windows } = state.model, kept = [];
  for (let i = 0; i < state.model.num; i++)
    if (!state.selected[i] || (windows[2 * i] < t && t < windows[2 * i + 1])) kept.push(i);
  const held = gathered(state, kept, Uint8Array.from(kept, (i) => state.selected[i])), { model } = held;
  const still = model.windows, { degree } = model;
  const names = ["loc", "log_scale", "coefficients", "time_loc", "log_time_scale", ...(model.paths ? ["angle_logit", "path_index"] : [])];
  const after = withChanged(held, names, (leaves, i) => {
    const { x, y, a } = condition(model, i, time, 0), path = model.paths ? leaves.path_index[i] : 0;
    [leaves.loc[2 * i], leaves.loc[2 * i + 1]] = [x, y];
    for (const k of [2 * i, 2 * i + 1]) leaves.log_scale[k] += 0.5 * Math.log(a);
    if (path) {
      const map = mapsAt(model.paths, time).subarray(6 * path, 6 * path + 6);
      mapAxes(leaves, i, [map[0], map[1], map[3], map[4]]);
      leaves.path_index[i] = 0;
    }
    leaves.coefficients.fill(0, 2 * degree * i, 2 * degree * (i + 1));
    leaves.time_loc[i] = 0.5;
    leaves.log_time_scale[i] = STATIC;
    [still[2 * i], still[2 * i + 1]] = [-1e4, 1e4];
  });
  return after;
}
