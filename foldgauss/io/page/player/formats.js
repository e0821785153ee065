// Files that the player opens, told apart by their first bytes: compact models, model files and PLY files of VeGaS and 3DGS.
import { readPly } from "./ply.js";
import { readSafetensors } from "./safetensors.js";
import { isScene, readScene } from "./scene.js";
import { readVegas } from "./vegas.js";

const COMPACT = [0x8b, 0x46, 0x47, 0x5a];

/** Formats that people try, by their first bytes, and what to do with them. */
const OTHERS = [
  [/^\x89PNG|^\xff\xd8\xff|^GIF8|^RIFF....WEBP/s, "a picture", "Fit a model to it first: foldgauss fit."],
  [/^....ftyp|^\x1aE\xdf\xa3|^RIFF....AVI/s, "a video", "Fit a model to it first: foldgauss fit CLIP."],
  [/^PK\x03\x04/, "a zip archive, as of SuperSplat's .sog", "Unpack it, and open the model in it."],
  [/^\s*<!doctype html/i, "a page of the player", "Open it in a tab of its own."],
];

/** Whether a file that begins with these bytes is a compact model. */
export const isCompact = (bytes) => COMPACT.every((own, k) => bytes[k] === own);

/** The {header, leaves} of a file that is not compact, as of `decode`. `given`: {size, fps} where the file holds none. Throws an Error for display. */
export function readModel(buffer, given = {}) {
  const bytes = new Uint8Array(buffer), start = String.fromCharCode(...bytes.subarray(0, 32));
  if (!bytes.length) throw new Error("The file is empty.");
  if (/^ply\r?\n/.test(start)) return checked(readPlyModel(buffer, given));
  if (start[8] === "{") return checked(readSafetensors(buffer));
  const known = OTHERS.find(([pattern]) => pattern.test(start));
  const got = known ? known[1] : "something else";
  throw new Error(`This is ${got}. Expected a model: .safetensors or .fgz of foldgauss, or a .ply of VeGaS or 3DGS. ${known ? known[2] : "Is it the right file?"}`);
}

function readPlyModel(buffer, given) {
  const found = readPly(buffer), { vertex, chunk } = found.elements;
  if (vertex?.m_0) return readVegas(found, given);
  if (isScene(vertex)) return readScene(found);
  if (chunk && vertex?.packed_position) throw new Error("This is a compressed 3DGS scene. Save it in SuperSplat as a .ply without compression, and open that.");
  throw new Error("This PLY file is neither a video of VeGaS, which has m_0, nor a 3DGS scene, which has f_dc_0, opacity, scale_2 and rot_3. It may be a mesh or a point cloud.");
}

function checked({ header, leaves }) {
  if (!(header.num_gaussians > 0)) throw new Error("The model has no Gaussians.");
  check(header, leaves);
  return { header, leaves };
}

/** Refuse values that cannot be rendered. */
export function check(header, leaves) {
  for (const [name, leaf] of Object.entries(leaves))
    for (let k = 0; k < leaf.length; k++)
      if (!Number.isFinite(leaf[k])) throw new Error(`The file is damaged: ${name} has a value that is not finite. Copy or fit it again.`);
  if (leaves.path_index?.some((path) => path > header.paths.num_paths)) throw new Error("The file is damaged: path_index has the number of a path that is not there. Copy or fit it again.");
}
