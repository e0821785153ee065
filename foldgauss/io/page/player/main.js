// The page's beginning: as a worker, decode; as a page, decode in a worker, then play.
import { element } from "./elements.js";
import { Controls } from "./controls.js";
import { Decoder, serve, spansOfPage } from "./loading.js";
import { Player } from "./player.js";
import { Renderer } from "./renderer.js";
import { Segments } from "./segments.js";

/** Tell people in place of the picture; `share` of 0 to 1 as a bar. */
function tell(text, share) {
  element("notice").hidden = text === "";
  element("notice-text").textContent = text;
  element("notice-bar").hidden = share === undefined;
  element("notice-bar").value = share ?? 0;
}

/** Keep the player up when the graphics card drops its context. */
function survive(canvas, player) {
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    tell("The graphics card has let go of this page. It comes back by itself, or when the page is loaded again.");
  });
  canvas.addEventListener("webglcontextrestored", () => {
    player.renderer.restore();
    tell("");
    player.invalidate();
  });
}

/** What tests and scripts may use; see docs/player.md. */
function hooks(player) {
  return {
    seek: (time) => player.seek(time),
    pixels: (width, height) => player.pixels(width, height),
    get stats() {
      const { alive, rate, position, time, playing, speed, loop, mode, edit, view, brushing } = player;
      const picked = player.selection.count, zoom = view.zoom, [height, width] = player.model.header.size;
      const { segments } = player, { total } = segments, numFrames = player.timeline.last + 1;
      const decoded = [...segments.held.keys()].sort((a, b) => a - b), textures = player.renderer.held.size;
      const parts = { segment: player.lead.number, segments: segments.spans.length, decoded, textures, missing: segments.missing };
      const about = { total, numFrames, width, height, loadSeconds: player.loadSeconds, ...parts };
      return { alive, rate, position, time, playing, speed, loop, mode, edit: { ...edit }, picked, zoom, brushing, ...about };
    },
  };
}

let failed = false; // what is told then stays, though a worker may still be decoding

async function start() {
  const canvas = element("canvas");
  tell("Decoding", 0);
  const decoder = new Decoder();
  const loading = decoder.decode(0, (share) => failed || tell("Decoding", share));
  const renderer = new Renderer(canvas); // its programs are compiled meanwhile
  const segments = new Segments(await loading, spansOfPage(), decoder);
  let controls;
  const player = new Player(canvas, renderer, segments, () => controls?.update());
  controls = new Controls(player);
  survive(canvas, player);
  segments.onError = (error) => {
    player.pause();
    tell(error.message);
  };
  tell("");
  player.loadSeconds = performance.now() / 1000;
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches && player.timeline.last > 0) player.play();
  else player.changed();
  setTimeout(() => !player.playing && player.pause(), 150); // the first picture has the model's own pixels, to be there soon
  requestAnimationFrame(() => requestAnimationFrame(() => segments.begin()));
  window.foldgauss.player = player;
  Object.defineProperties(window.foldgauss, Object.getOwnPropertyDescriptors(hooks(player)));
}

if (typeof document === "undefined") serve(self);
else {
  const ready = start();
  window.foldgauss = { ready };
  ready.catch((error) => {
    failed = true;
    tell(error.message);
  });
}
