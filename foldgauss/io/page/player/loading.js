// Decoding apart from the page, in a worker of its own script; on the page where a browser allows no worker.
import { prepared } from "./gaussians.js";

/** The bytes of one of the page's data blocks, or null where there is none. */
export function blockOf(name) {
  const block = document.getElementById(name);
  return block && bytesOf(block.textContent);
}

function bytesOf(text) {
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let k = 0; k < binary.length; k++) bytes[k] = binary.charCodeAt(k);
  return bytes;
}

/** The worker's side: messages with a file's text, answers with the share done, then the model or an error. */
export function serve(scope) {
  scope.onmessage = ({ data }) => {
    try {
      const model = prepared(bytesOf(data).buffer, (share) => scope.postMessage({ share }));
      scope.postMessage({ model }, [model.values.buffer, model.windows.buffer]);
    } catch (error) {
      scope.postMessage({ error: error.message });
    }
  };
}

/** The segments' spans, of a page that has more models than one. */
export function spansOfPage() {
  return JSON.parse(document.getElementById("segments")?.textContent ?? "null");
}

function started() {
  const script = new Blob([document.getElementById("player").textContent], { type: "text/javascript" });
  return new Worker(URL.createObjectURL(script));
}

/** Decodes the page's models, one at a time. */
export class Decoder {
  constructor() {
    this.blocks = [...document.querySelectorAll('script[id^="model"]')]; // in the clip's order
  }

  /** Of all models, as they are in the page. */
  get numBytes() {
    return this.blocks.reduce((sum, { textContent }) => sum + (textContent.length * 3) / 4, 0);
  }

  /** A model, decoded; `onShare` is told how far that has come. */
  decode(number, onShare) {
    const text = this.blocks[number].textContent;
    return new Promise((resolve, reject) => {
      const here = () => {
        this.stop();
        try {
          resolve(prepared(bytesOf(text).buffer, onShare));
        } catch (error) {
          reject(error);
        }
      };
      try {
        this.worker ??= started();
      } catch {
        setTimeout(here);
        return;
      }
      this.worker.onerror = here;
      this.worker.onmessage = ({ data }) => {
        if ("share" in data) return onShare(data.share);
        return data.error ? reject(new Error(data.error)) : resolve(data.model);
      };
      this.worker.postMessage(text);
    });
  }

  /** Leave what is being decoded: its promise is never kept. */
  stop() {
    this.worker?.terminate();
    this.worker = null;
  }
}
