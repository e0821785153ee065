// Decoding in a worker that runs the page's own script, or on the page where no worker is allowed.
import { readModel } from "./formats.js";
import { prepare } from "./gaussians.js";

export function bytesOf(text) {
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let k = 0; k < binary.length; k++) bytes[k] = binary.charCodeAt(k);
  return bytes;
}

/** A model to decode: `data` is a file's bytes, or the text of a block of the page, in base64; `given`: see `readModel`. */
const decodeSource = ({ data, given }, onProgress) =>
  prepare(readModel(typeof data === "string" ? bytesOf(data).buffer : data, given, onProgress));

/** The worker: receives a source, answers with the fraction decoded, then with the model or an error. */
export function serve(scope) {
  scope.onmessage = ({ data }) => {
    try {
      const model = decodeSource(data, (fraction) => scope.postMessage({ fraction }));
      const arrays = [model.values, model.windows, ...Object.values(model.leaves)];
      scope.postMessage({ model }, [...new Set(arrays.map((own) => own.buffer))]);
    } catch (error) {
      scope.postMessage({ error: error.message, missing: error.missing });
    }
  };
}

/** The spans of the page's segments; null for a page with one model. */
export function spansOfPage() {
  return JSON.parse(document.getElementById("segments")?.textContent ?? "null");
}

/** The page's models, in order of time. */
export const sourcesOfPage = () => [...document.querySelectorAll('script[id^="model"]')].map((block) => ({ data: block.textContent }));

function startWorker() {
  const script = new Blob([document.getElementById("player").textContent], { type: "text/javascript" });
  return new Worker(URL.createObjectURL(script));
}

/** Decodes models, one at a time. */
export class Decoder {
  constructor(sources) {
    this.sources = sources;
  }

  /** Size of all models. */
  get numBytes() {
    return this.sources.reduce((sum, { data }) => sum + (typeof data === "string" ? (data.length * 3) / 4 : data.byteLength), 0);
  }

  /** Decode a model; `onProgress` is called with the fraction decoded. */
  decode(number, onProgress) {
    const source = this.sources[number];
    return new Promise((resolve, reject) => {
      const here = () => {
        this.stop();
        try {
          resolve(decodeSource(source, onProgress));
        } catch (error) {
          reject(error);
        }
      };
      try {
        this.worker ??= startWorker();
      } catch {
        setTimeout(here);
        return;
      }
      this.worker.onerror = here;
      this.worker.onmessage = ({ data }) => {
        if ("fraction" in data) return onProgress(data.fraction);
        return data.error ? reject(Object.assign(new Error(data.error), { missing: data.missing })) : resolve(data.model);
      };
      this.worker.postMessage(source);
    });
  }

  /** Stop decoding: the promise is never settled. */
  stop() {
    this.worker?.terminate();
    this.worker = null;
  }
}
