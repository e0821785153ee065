// PLY files of the published VeGaS code: the twin of foldgauss.io.exchange.vegas_ply.read_vegas_ply, where the formulas are.
import { STATIC } from "./gaussians.js";

const FIELD_OF_VIEW = 0.6911112; // radians
const POWER = 2, SCALE_CUTOFF = 1e-4; // of the published code
const OPTIONS = { low_pass: 0.3, alpha_cutoff: 1 / 255, alpha_ceiling: 0.99, transmittance_stop: 1e-4, tile_size: null, list_capacity: null, support_radius: null };
const TYPES = {
  float: [4, "getFloat32"], float32: [4, "getFloat32"], double: [8, "getFloat64"], float64: [8, "getFloat64"],
  uchar: [1, "getUint8"], uint8: [1, "getUint8"], char: [1, "getInt8"], int8: [1, "getInt8"], ushort: [2, "getUint16"], uint16: [2, "getUint16"],
  short: [2, "getInt16"], int16: [2, "getInt16"], uint: [4, "getUint32"], uint32: [4, "getUint32"], int: [4, "getInt32"], int32: [4, "getInt32"],
};
const NOTE = "comment foldgauss ";

/** {header, leaves}. `given`: {size, fps}, which files of the published code lack: an Error says so by `missing`. */
export function readVegas(buffer, given) {
  const { elements, note } = readPly(buffer), { vertex, time } = elements;
  if (!vertex?.m_0 && vertex?.f_dc_0) throw new Error("This is a still 3DGS scene, in space. The player shows videos in a plane: open it in SuperSplat. Of a frame that foldgauss exported, open the model itself.");
  if (!vertex?.m_0 || !vertex.sigma_0 || !vertex.rot_0 || !time) throw new Error("This PLY file is no video of VeGaS, which has m_0, sigma_0, rot_0 and an element time. Is it the right file?");
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
    log_time_scale: Float32Array.from(vertex.sigma_0, (own) => (own === STATIC ? own : own + 0.5 * Math.log(power / POWER))),
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

/** The elements of a binary little-endian or ASCII file, as columns, and the facts in our own comment. */
function readPly(buffer) {
  const head = new TextDecoder("latin1").decode(new Uint8Array(buffer, 0, Math.min(buffer.byteLength, 1 << 20))), found = /\nend_header\r?\n/.exec(head);
  if (!found) throw new Error("The PLY file has no end of its header. It is damaged: copy it again.");
  const layout = [], lines = head.slice(0, found.index).split(/\r?\n/), note = lines.find((line) => line.startsWith(NOTE));
  const format = lines.find((line) => line.startsWith("format "))?.split(" ")[1];
  for (const line of lines) {
    const [word, one, other] = line.split(/\s+/);
    if (word === "element") layout.push({ name: one, num: Number(other), properties: [] });
    if (word === "property" && !TYPES[one]) throw new Error(`The PLY file has a property of the type ${JSON.stringify(one)}, which no file of VeGaS has.`);
    if (word === "property") layout.at(-1)?.properties.push([other, ...TYPES[one]]);
  }
  const start = found.index + found[0].length, elements = {};
  if (format === "ascii") readText(new TextDecoder("latin1").decode(new Uint8Array(buffer, start)), layout, elements);
  else if (format?.startsWith("binary")) readBinary(new DataView(buffer, start), layout, elements, format === "binary_little_endian");
  else throw new Error("The PLY file names no format that is known. It is damaged: copy it again.");
  return { elements, note: note ? JSON.parse(note.slice(NOTE.length)) : {} };
}

function readBinary(view, layout, elements, little) {
  let at = 0;
  for (const { name, num, properties } of layout) {
    const width = properties.reduce((sum, [, size]) => sum + size, 0);
    if (!(at + num * width <= view.byteLength)) throw new Error("The PLY file is cut short. Copy it again.");
    elements[name] = {};
    let offset = at;
    for (const [own, size, read] of properties) {
      const column = (elements[name][own] = new Float64Array(num));
      for (let i = 0; i < num; i++) column[i] = view[read](offset + i * width, little);
      offset += size;
    }
    at += num * width;
  }
}

function readText(text, layout, elements) {
  const words = text.split(/\s+/);
  let at = words[0] === "" ? 1 : 0;
  for (const { name, num, properties } of layout) {
    if (at + num * properties.length > words.length) throw new Error("The PLY file is cut short. Copy it again.");
    const columns = properties.map(() => new Float64Array(num));
    for (let i = 0; i < num; i++) for (const column of columns) column[i] = Number(words[at++]);
    elements[name] = Object.fromEntries(properties.map(([own], k) => [own, columns[k]]));
  }
}
