// Model files of foldgauss, safetensors with a header of their own: see foldgauss.io.models.model_file and docs/format.md.
import { withoutUnused } from "./paths.js";

const FORMAT = "foldgauss-model", VERSION = "1";
const ARRAYS = { F32: Float32Array, U8: Uint8Array };
const MOST_PATHS = 255;
const EARLY = 1e-6; // of the clip: rounding of times
const DAMAGED = "The file is damaged or cut short. Copy it again.";

/** {header, leaves} of a video model. Throws an Error for display. */
export function readSafetensors(buffer) {
  const { about, tensor } = readTensors(buffer);
  if (about.kind === "segmented-video") throw new Error("This is a model in segments, which the page cannot open as a file. Write its page with foldgauss view --out, or extract one segment with foldgauss export --format model --segment.");
  if (about.kind === "edited-video") throw new Error("This is an edited video whose edits no folded model holds. Render it with foldgauss render, or open the model and the edit script.");
  if (about.kind !== "video") throw new Error(`This is a ${JSON.stringify(about.kind)}, not a model. Open the file that foldgauss fit wrote.`);
  const header = JSON.parse(about.header), { num_gaussians: num, degree } = header;
  const leaf = (name) => tensor(`splats.${name}`), envelope = (name) => {
    const own = tensor(`splats.envelope.${name}`);
    if (own.length !== 1 || !Number.isFinite(own[0])) throw new Error(DAMAGED);
    return own[0];
  };
  const leaves = {};
  for (const name of ["loc", "log_scale", "angle_logit", "time_loc_logit", "log_time_scale", "coefficients", "opacity_logit", "color_dc"]) leaves[name] = leaf(name);
  leaves.frame_times = tensor("frame_times.logits");
  const widths = { loc: 2, log_scale: 2, coefficients: 2 * degree, color_dc: 3 }, [numPaths, knots] = header.paths ?? [0, 0];
  if (numPaths) Object.assign(leaves, { path_index: leaf("path_index"), path_times: leaf("paths.times"), path_matrices: leaf("paths.matrices") });
  const lengths = { frame_times: header.num_frames - 1, path_times: numPaths * knots, path_matrices: 6 * numPaths * knots };
  for (const [name, own] of Object.entries(leaves))
    if (own.length !== (lengths[name] ?? num * (widths[name] ?? 1))) throw new Error(DAMAGED);
  const paths = numPaths ? { num_paths: numPaths, num_knots: knots } : null;
  return { header: { compositing: "over", scale_cutoff: 0, ...header, metadata: readMetadata(about), paths, power: envelope("power"), floor: envelope("floor") }, leaves };
}

/** The free part of a file's header; null where it is no JSON. */
function readMetadata({ metadata }) {
  try {
    return JSON.parse(metadata);
  } catch {
    return null;
  }
}

/** The file's own header, and a function that gives a tensor's values by name. */
function readTensors(buffer) {
  let entries, start;
  try {
    start = 8 + Number(new DataView(buffer).getBigUint64(0, true));
    entries = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(new Uint8Array(buffer, 8, start - 8)));
  } catch {
    throw new Error(DAMAGED);
  }
  const about = entries.__metadata__ ?? {};
  if (about.format !== FORMAT) throw new Error("This is a safetensors file of another program. Open the file that foldgauss fit wrote.");
  if (about.version !== VERSION) throw new Error(`This model file has version ${about.version}; the page reads version ${VERSION}. Write the page with the newer foldgauss.`);
  const tensor = (name) => {
    const { dtype, data_offsets: [from, to] = [] } = entries[name] ?? {}, kind = ARRAYS[dtype];
    if (!kind || !(from >= 0 && to >= from && start + to <= buffer.byteLength)) throw new Error(DAMAGED);
    return new kind(buffer.slice(start + from, start + to));
  };
  return { about, tensor };
}

/** A model as a file that foldgauss opens. Throws an Error for display where none can hold it. */
export function writeSafetensors(model, metadata) {
  const { header, num, degree, leaves, intervals, windows } = model, { paths, index } = withoutUnused(model);
  const { held, time_loc: times } = leaves, isStill = (own, i) => (windows[2 * i] < held[2 * i] && held[2 * i] > EARLY) || (windows[2 * i + 1] > held[2 * i + 1] && held[2 * i + 1] < 1 - EARLY);
  const beyond = times.filter((own, i) => !(own > 0 && own < 1) || isStill(own, i));
  if (beyond.length) throw new Error(`${beyond.length.toLocaleString("en")} Gaussians were moved in time, beyond the clip or to where they begin or end within it, which no model file holds. Download the edit script, and render it: foldgauss edit MODEL SCRIPT --out edited.mp4.`);
  if (paths?.count > MOST_PATHS) throw new Error(`The edits give Gaussians ${paths.count} shared paths; a model file holds ${MOST_PATHS}. Make fewer copies; or download the edit script, and render it: foldgauss edit MODEL SCRIPT --out edited.mp4.`);
  const logits = Float32Array.from(leaves.time_loc, (own) => Math.log(own) - Math.log1p(-own));
  const tensors = {
    "frame_times.logits": [intervals, [intervals.length]], "splats.angle_logit": [leaves.angle_logit, [num]],
    "splats.coefficients": [leaves.coefficients, [num, degree, 2]], "splats.color_dc": [leaves.color_dc, [num, 3]],
    "splats.envelope.floor": [Float32Array.of(header.floor), []], "splats.envelope.power": [Float32Array.of(header.power), []],
    "splats.loc": [leaves.loc, [num, 2]], "splats.log_scale": [leaves.log_scale, [num, 2]],
    "splats.log_time_scale": [leaves.log_time_scale, [num]], "splats.opacity_logit": [leaves.opacity_logit, [num]],
    "splats.time_loc_logit": [logits, [num]],
  };
  if (paths) {
    tensors["splats.paths.matrices"] = [Float32Array.from(paths.matrices), [paths.count, paths.knots, 2, 3]];
    tensors["splats.paths.times"] = [Float32Array.from(paths.times), [paths.count, paths.knots]];
    tensors["splats.path_index"] = [Uint8Array.from(index), [num], "U8"];
  }
  const own = {
    num_gaussians: num, degree, envelope: "TimeLikelihood", num_frames: intervals.length + 1, size: header.size, fps: header.fps,
    options: header.options, compositing: header.compositing, scale_cutoff: header.scale_cutoff,
    ...(paths ? { paths: [paths.count, paths.knots] } : {}),
  };
  const about = { format: FORMAT, version: VERSION, kind: "video", header: JSON.stringify(own), metadata: JSON.stringify(metadata) };
  const entries = { __metadata__: about };
  let end = 0;
  for (const [name, [values, shape, dtype = "F32"]] of Object.entries(tensors)) entries[name] = { dtype, shape, data_offsets: [end, (end += values.byteLength)] };
  const text = new TextEncoder().encode(JSON.stringify(entries));
  const padded = new Uint8Array(8 * Math.ceil(text.length / 8)).fill(32);
  padded.set(text);
  const length = new DataView(new ArrayBuffer(8));
  length.setBigUint64(0, BigInt(padded.length), true);
  return new Blob([length.buffer, padded, ...Object.values(tensors).map(([values]) => values)], { type: "application/octet-stream" });
}
