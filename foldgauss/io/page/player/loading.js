// Decoding in a worker that runs the page's own script, or on the page where no worker is allowed.
import { prepare } from "./gaussians.js";

/** The bytes of a data block of the page, or null if it is missing. */
export function blockOf(name) {
  const block = document.getElementById(name);
  return block && bytesOf(block.textContent);
}

function bytesOf(text) {
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let k = 0; k < binary.length; k++) bytes[k] = binary.charCodeAt(k);
  return bytes;
}

/** The worker: receives a file's text, answers with the fraction decoded, then with the model or an error. */
export function serve(scope) {
  scope.onmessage = ({ data }) => {
    try {
      const model = prepare(bytesOf(data).buffer, (fraction) => scope.postMessage({ fraction }));
      scope.postMessage({ model }, [model.values.buffer, model.windows.buffer]);
    } catch (error) {
      scope.postMessage({ error: error.message });
    }
  };
}

/** The spans of the segments; null for a page with one model. */
export function spansOfPage() {
  return JSON.parse(document.getElementById("segments")?.textContent ?? "null");
}

function startWorker() {
  const script = new Blob([document.getElementById("player").textContent], { type: "text/javascript" });
  return new Worker(URL.createObjectURL(script));
}

/** Decodes the page's models, one at a time. */
export class Decoder {
  constructor() {
    this.blocks = [...document.querySelectorAll('script[id^="model"]')]; // in order of time
  }

  /** Size of all models in the page. */
  get numBytes() {
    return this.blocks.reduce((sum, { textContent }) => sum + (textContent.length * 3) / 4, 0);
  }

  /** Decode a model; `onProgress` is called with the fraction decoded. */
  decode(number, onProgress) {
    const text = this.blocks[number].textContent;
    return new Promise((resolve, reject) => {
      const here = () => {
        this.stop();
        try {
          resolve(prepare(bytesOf(text).buffer, onProgress));
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
        return data.error ? reject(new Error(data.error)) : resolve(data.model);
      };
      this.worker.postMessage(text);
    });
  }

  /** Stop decoding: the promise is never settled. */
  stop() {
    this.worker?.terminate();
    this.worker = null;
  }
}
