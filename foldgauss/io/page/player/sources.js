// A model file's bytes, read in parts: of a block of the page or a file on the disk by slices, of an address by ranges.

/** Bytes of the first request to a server. They hold the header, the block of motion, and often the first chunk. */
const FIRST = 65536;

export function bytesOf(text) {
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let k = 0; k < binary.length; k++) bytes[k] = binary.charCodeAt(k);
  return bytes;
}

/**
 * A source as {read, received, inOrder}: `read(start, stop)` gives its bytes, fewer where it ends before; `received`: how
 * many were read; with `inOrder` they come one after another. `data`: bytes, a Blob, or the text of a block of the page in
 * base64; without it `url` is read.
 */
export function openSource({ data, url }) {
  if (data === undefined) return openAddress(url);
  const blob = new Blob([typeof data === "string" ? bytesOf(data) : data]);
  const file = { received: 0 };
  const read = async (start, stop) => receive(file, await blob.slice(start, stop).arrayBuffer());
  return Object.assign(file, { read });
}

function receive(file, buffer) {
  file.received += buffer.byteLength;
  return new Uint8Array(buffer);
}

async function openAddress(url) {
  const name = nameOf(url);
  if (url.startsWith("file:")) throw new Error(`A page on the disk cannot read the file beside it: drop ${name} onto the page, or serve the folder over HTTP (python -m http.server).`);
  const ask = (start, stop) => fetch(url, { headers: { Range: `bytes=${start}-${stop - 1}` } });
  const first = await ask(0, FIRST).catch(() => ({ status: "nothing" }));
  if (first.status === 200) return readInOrder(first.body.getReader());
  if (first.status !== 206) throw new Error(`${name} cannot be read: the server answers ${first.status}.`);
  const file = { received: 0 }, head = receive(file, await first.arrayBuffer());
  const read = async (start, stop) => {
    if (stop <= head.length) return head.subarray(start, stop);
    const answer = await ask(Math.max(start, head.length), stop);
    if (answer.status !== 206) throw new Error(`the server answers ${answer.status}`);
    return join(head.subarray(start), receive(file, await answer.arrayBuffer()));
  };
  return Object.assign(file, { read });
}

/** The name of a file, as its address has it where it is no UTF-8. */
function nameOf(url) {
  const name = url.split("/").at(-1);
  try {
    return decodeURIComponent(name);
  } catch {
    return name;
  }
}

/** Of a server without ranges: what has arrived is kept. */
function readInOrder(reader) {
  const file = { received: 0, inOrder: true };
  let bytes = new Uint8Array(FIRST), ended = false;
  const pull = async () => {
    const { done, value } = await reader.read();
    ended = done;
    if (done) return;
    if (file.received + value.length > bytes.length) bytes = join(bytes, new Uint8Array(bytes.length + value.length));
    bytes.set(value, file.received);
    file.received += value.length;
  };
  const read = async (start, stop) => {
    while (file.received < stop && !ended) await pull();
    return bytes.subarray(start, Math.min(stop, file.received));
  };
  return Object.assign(file, { read });
}

function join(one, other) {
  const bytes = new Uint8Array(one.length + other.length);
  bytes.set(one);
  bytes.set(other, one.length);
  return bytes;
}
