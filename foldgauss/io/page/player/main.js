// Entry point: in a worker, decode; in the page, decode in a worker, then play. A page without a model waits for one.
import { Controls } from "./controls.js";
import { element, notify } from "./elements.js";
import { Files } from "./files.js";
import { Decoder, serve, sourcesOfPage, spansOfPage } from "./loading.js";
import { Originals } from "./originals.js";
import { Player } from "./player.js";
import { Renderer } from "./renderer.js";
import { Segments } from "./segments.js";
import { bindShell } from "./shell.js";

const WELCOME = "Open a model, or drop one here: .safetensors or .fgz of foldgauss, or a .ply of VeGaS or 3DGS. It stays on this computer.";

/** Restore the player after the graphics card has lost its context. */
function restoreOnLoss(canvas, player) {
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    notify("The graphics context was lost. It is restored automatically, or when the page is reloaded.");
  });
  canvas.addEventListener("webglcontextrestored", () => {
    player.renderer.restore();
    notify("");
    player.invalidate();
  });
}

/** Interface for tests and scripts; see docs/player.md. */
function hooks(player, controls) {
  return {
    seek: (time) => player.seek(time),
    pixels: (width, height) => player.pixels(width, height),
    get stats() {
      const { alive, rate, position, time, playing, speed, loop, mode, view, segments, editing, lead } = player;
      const { history } = editing, [height, width] = player.base.header.size, { total, decoder: { arrived } } = segments, { tools } = controls;
      const decoded = [...segments.held.keys()].sort((a, b) => a - b), textures = player.renderer.held.size;
      return {
        alive, total, rate, position, time, playing, speed, loop, mode, zoom: view.zoom, width, height, textures, decoded,
        numFrames: player.timeline.last + 1, segment: lead.number, segments: segments.spans.length, missing: segments.missing,
        editing: player.highlighting, tool: tools.name, how: tools.how, picked: editing.count(lead.number, lead.base),
        loaded: arrived.loaded, chunks: arrived.chunks, bytesRead: arrived.bytes, steps: history.current, undoable: history.done, redoable: history.steps.length - history.done, loadSeconds: player.loadSeconds,
      };
    },
  };
}

let failed = false; // the error message stays, though a worker may still be decoding

async function start() {
  bindShell();
  const canvas = element("canvas"), sources = sourcesOfPage(), decoder = new Decoder(sources);
  if (sources.length) notify("Decoding", 0);
  const loading = sources.length && decoder.decode(0, (fraction) => failed || notify("Decoding", fraction));
  const renderer = new Renderer(canvas); // compiles its programs meanwhile
  let controls;
  const player = new Player(canvas, renderer, () => controls?.update());
  restoreOnLoss(canvas, player);

  const show = (segments, title, originals) => {
    if (player.segments !== segments) player.segments?.decoder.stop();
    player.open(segments, originals);
    segments.onWhole = () => files.attach(title);
    segments.onError = (error) => {
      player.pause();
      notify(error.message);
    };
    document.title = element("title").textContent = title;
    controls ??= new Controls(player, files);
    element("transport").hidden = false;
    notify("");
    controls.describe();
    files.attach(title);
    player.loadSeconds = performance.now() / 1000;
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches && player.timeline.last > 0) player.play();
    else player.changed();
    setTimeout(() => !player.playing && player.pause(), 150); // the first image has the model's own size, to appear early
    requestAnimationFrame(() => requestAnimationFrame(() => segments.begin()));
    Object.assign(window.foldgauss, { player, controls, files });
    Object.defineProperties(window.foldgauss, Object.getOwnPropertyDescriptors(hooks(player, controls)));
  };
  const welcome = () => {
    element("transport").hidden = true;
    notify(WELCOME);
    element("notice-open").hidden = false;
  };
  const files = new Files(player, show, (text, fraction) => (text || player.segments ? notify(text, fraction) : welcome()));
  if (!sources.length) return welcome();
  files.isOfPage = true;
  const frames = [...document.querySelectorAll('script[id^="frame-"]')];
  const lead = await loading;
  if (player.segments) return decoder.stop(); // another model was opened meanwhile
  show(new Segments(lead, spansOfPage(), decoder), element("title").textContent, new Originals(frames, () => {}));
}

if (typeof document === "undefined") serve(self);
else {
  window.foldgauss = {};
  window.foldgauss.ready = start();
  window.foldgauss.ready.catch((error) => {
    failed = true;
    notify(error.message);
  });
}
