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

/** The worker's side: one message with the file's text, answers with the share done, then the model or an error. */
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

/** The page's model, decoded; `onShare` is told how far that has come. */
export function load(onShare) {
  const text = document.getElementById("model").textContent;
  return new Promise((resolve, reject) => {
    const here = () => {
      try {
        resolve(prepared(bytesOf(text).buffer, onShare));
      } catch (error) {
        reject(error);
      }
    };
    let worker;
    try {
      const script = new Blob([document.getElementById("player").textContent], { type: "text/javascript" });
      worker = new Worker(URL.createObjectURL(script));
    } catch {
      setTimeout(here);
      return;
    }
    worker.onerror = () => {
      worker.terminate();
      here();
    };
    worker.onmessage = ({ data }) => {
      if ("share" in data) return onShare(data.share);
      worker.terminate();
      return data.error ? reject(new Error(data.error)) : resolve(data.model);
    };
    worker.postMessage(text);
  });
}
