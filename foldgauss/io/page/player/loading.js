// Decoding in a worker that runs the page's own script, or on the page where no worker is allowed. A compact model comes
// in parts: first its motion and its first chunk, then its other chunks, those for the time shown first.
import { decodeChunk, decodeMotion, emptyLeaves, headerBytes, readHeader } from "./compact.js";
import { check, isCompact, readModel } from "./formats.js";
import { place, prepare, prepareRows } from "./gaussians.js";
import { openSource } from "./sources.js";

const START = 20; // bytes that tell a format, and a compact model's length of the header

/** Why a model cannot be edited yet. */
export const UNFINISHED = "The model can be edited once all of it has arrived.";

/** What has arrived of a model: `loaded` and `lost` of its `chunks`, `coming`: when those to come are visible. */
const ALL = { loaded: 1, lost: 0, chunks: 1, fraction: 1, bytes: 0, coming: [] };

/**
 * Decode a source, {data, url, given}, see `openSource` and `readModel`. `post` is called with {fraction}, as far as the
 * first image is decoded; with {model, arrived}, a model in which Gaussians to come are invisible; with {part, arrived}
 * for what is to be placed in it, null for a chunk that is damaged or missing; or with {error}. `wish`: {time, stopped},
 * the time shown, and whether to stop, which may change at any time.
 */
export async function load(source, post, wish) {
  try {
    const file = await openSource(source), start = await file.read(0, START);
    if (source.url || isCompact(start)) return await loadChunks(file, headerBytes(start), post, wish);
    const { buffer } = await file.read(0, Infinity);
    post({ model: prepare(readModel(buffer, source.given)), arrived: { ...ALL, bytes: file.received } });
  } catch (error) {
    post({ error: error.message, missing: error.missing });
  }
}

async function loadChunks(file, length, post, wish) {
  const header = readHeader(await file.read(0, length)), { motion, chunks } = header, left = [...chunks];
  const shared = decodeMotion(header, await file.read(motion.start, motion.stop));
  check(header, shared);
  let model = prepare({ header, leaves: { ...emptyLeaves(header), ...shared } }), loaded = 0, lost = 0, done = 0;
  const next = () => {
    if (!left.length) return null;
    const isFirst = left.length === chunks.length, [chunk] = left.splice(isFirst || file.inOrder ? 0 : mostWanted(left, wish.time), 1);
    return { chunk, bytes: file.read(chunk.start, chunk.stop).catch(() => null) };
  };
  for (let own = next(), following; own && !wish.stopped; own = following) {
    const { chunk } = own, bytes = await own.bytes;
    following = next(); // is read meanwhile
    const part = decodePart(header, chunk, bytes, (fraction) => model && post({ fraction }));
    if (part) loaded++;
    else if (++lost === chunks.length) throw new Error("The file is damaged or cut short: no part of it can be shown. Copy it again.");
    done += chunk.num_gaussians;
    const coming = [...(following ? [following.chunk] : []), ...left].map(({ visible }) => visible);
    const arrived = { loaded, lost, chunks: chunks.length, fraction: done / header.num_gaussians, size: chunks.at(-1).stop, coming, bytes: file.received };
    if (!model) post({ part, arrived });
    else if (part) {
      place(model, part);
      post({ model, arrived });
      model = null; // it is the page's now
    }
    await new Promise((goOn) => setTimeout(goOn)); // for messages, and for the page
  }
}

/** What is to be placed in the model for a chunk; null if it is damaged or missing. */
function decodePart(header, chunk, bytes, onProgress) {
  try {
    const leaves = decodeChunk(header, chunk, bytes, onProgress);
    check(header, leaves);
    return { first: chunk.first, ...prepareRows(header, leaves, chunk.num_gaussians) };
  } catch {
    return null;
  }
}

/** Of the chunks that are left the one that is visible at a time, or the soonest when the clip plays on from there. */
function mostWanted(left, time) {
  const waits = left.map(({ visible: [first, last] }) => (first <= time && time <= last ? 0 : (first - time + 1) % 1));
  return waits.indexOf(Math.min(...waits));
}

/** The worker: receives a source, then the times shown. */
export function serve(scope) {
  const wish = { time: 0 };
  scope.onmessage = ({ data }) => {
    if (data.time !== undefined) wish.time = data.time;
    else load(data, (message) => scope.postMessage(message, buffersOf(message.model ?? message.part)), wish);
  };
}

function buffersOf(model) {
  const arrays = model ? [model.values, model.windows, ...Object.values(model.leaves)] : [];
  return [...new Set(arrays.map((own) => own.buffer))];
}

/** The spans of the page's segments; null for a page with one model. */
export function spansOfPage() {
  return JSON.parse(document.getElementById("segments")?.textContent ?? "null");
}

/** The page's models, in order of time: what is in it, or the address of a file beside it. */
export const sourcesOfPage = () => [...document.querySelectorAll('script[id^="model"]')].map((block) => {
  const { url } = block.dataset;
  return url ? { url: new URL(url, document.baseURI).href } : { data: block.textContent };
});

function startWorker() {
  const script = new Blob([document.getElementById("player").textContent], { type: "text/javascript" });
  return new Worker(URL.createObjectURL(script));
}

/** Decodes models, one at a time. */
export class Decoder {
  constructor(sources) {
    Object.assign(this, { sources, arrived: ALL, wish: { time: 0 }, onPart: () => {} });
  }

  /** Size of all models. */
  get numBytes() {
    const sizeOf = ({ data }) => (data === undefined ? this.arrived.size : typeof data === "string" ? (data.length * 3) / 4 : data.byteLength ?? data.size);
    return this.sources.reduce((sum, source) => sum + sizeOf(source), 0);
  }

  /** Whether all of the model has arrived, but for what is lost. */
  get isWhole() {
    const { loaded, lost, chunks } = this.arrived;
    return loaded + lost === chunks;
  }

  /** Decode a model; `onProgress` is called with the fraction decoded, and afterwards `onPart` with each part, null for a chunk that is lost. */
  decode(number, onProgress) {
    const source = this.sources[number];
    return new Promise((resolve, reject) => {
      const take = ({ fraction, model, part, arrived, error, missing }) => {
        if (fraction !== undefined) return onProgress(fraction);
        if (error !== undefined) return reject(Object.assign(new Error(error), { missing }));
        this.arrived = arrived;
        if (model) resolve(model);
        else this.onPart(part);
      };
      const here = () => {
        this.stop();
        const { wish } = this;
        load(source, (message) => wish.stopped || take(message), wish);
      };
      try {
        this.worker ??= startWorker();
      } catch {
        setTimeout(here);
        return;
      }
      this.worker.onerror = here;
      this.worker.onmessage = ({ data }) => take(data);
      this.worker.postMessage(source);
    });
  }

  /** Tell the time shown, whose chunks come first. */
  tell(time) {
    if (this.isWhole || time === this.wish.time) return;
    this.wish.time = time;
    this.worker?.postMessage({ time });
  }

  /** Whether something that is visible at a time has not arrived. */
  lacks(time) {
    return this.arrived.coming.some(([first, last]) => first <= time && time <= last);
  }

  /** Stop decoding: the promise is never settled. */
  stop() {
    this.worker?.terminate();
    this.worker = null;
    this.wish.stopped = true;
    this.wish = { time: this.wish.time };
  }
}
