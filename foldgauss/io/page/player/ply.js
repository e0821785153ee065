// PLY files as columns of numbers, whatever they mean.

const TYPES = {
  float: [4, "getFloat32"], float32: [4, "getFloat32"], double: [8, "getFloat64"], float64: [8, "getFloat64"],
  uchar: [1, "getUint8"], uint8: [1, "getUint8"], char: [1, "getInt8"], int8: [1, "getInt8"], ushort: [2, "getUint16"], uint16: [2, "getUint16"],
  short: [2, "getInt16"], int16: [2, "getInt16"], uint: [4, "getUint32"], uint32: [4, "getUint32"], int: [4, "getInt32"], int32: [4, "getInt32"],
};
const NOTE = "comment foldgauss ";
const UNUSED = /^(n[xyz]|f_rest_\d+)$/; // three quarters of a 3DGS file

/** {elements, note}: of each element of a binary or ASCII file its columns, and the facts in our own comment. */
export function readPly(buffer) {
  const head = new TextDecoder("latin1").decode(new Uint8Array(buffer, 0, Math.min(buffer.byteLength, 1 << 20))), found = /\nend_header\r?\n/.exec(head);
  if (!found) throw new Error("The PLY file has no end of its header. It is damaged: copy it again.");
  const layout = [], lines = head.slice(0, found.index).split(/\r?\n/), note = lines.find((line) => line.startsWith(NOTE));
  const format = lines.find((line) => line.startsWith("format "))?.split(" ")[1];
  for (const line of lines) {
    const [word, one, other] = line.split(/\s+/);
    if (word === "element") layout.push({ name: one, num: Number(other), properties: [] });
    if (word === "property" && !TYPES[one]) throw new Error(`The PLY file has a property of the type ${JSON.stringify(one)}, which no file of VeGaS or 3DGS has.`);
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
      if (!UNUSED.test(own)) {
        const column = (elements[name][own] = new Float64Array(num));
        for (let i = 0; i < num; i++) column[i] = view[read](offset + i * width, little);
      }
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
