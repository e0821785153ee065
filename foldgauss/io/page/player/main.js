// Entry point: in a worker, decode; in the page, decode in a worker, then play.
import { element } from "./elements.js";
import { Controls } from "./controls.js";
import { Decoder, serve, spansOfPage } from "./loading.js";
import { Player } from "./player.js";
import { Renderer } from "./renderer.js";
import { Segments } from "./segments.js";

/** Show a notice in place of the image, with a progress bar for a `fraction` in [0, 1]. */
function notify(text, fraction) {
  element("notice").hidden = text === "";
  element("notice-text").textContent = text;
  element("notice-bar").hidden = fraction === undefined;
  element("notice-bar").value = fraction ?? 0;
}

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

let failed = false; // the error message stays, though a worker may still be decoding

async function start() {
  const canvas = element("canvas");
  notify("Decoding", 0);
  const decoder = new Decoder();
  const loading = decoder.decode(0, (fraction) => failed || notify("Decoding", fraction));
  const renderer = new Renderer(canvas); // compiles its programs meanwhile
  const segments = new Segments(await loading, spansOfPage(), decoder);
  let controls;
  const player = new Player(canvas, renderer, segments, () => controls?.update());
  controls = new Controls(player);
  restoreOnLoss(canvas, player);
  segments.onError = (error) => {
    player.pause();
    notify(error.message);
  };
  notify("");
  player.loadSeconds = performance.now() / 1000;
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches && player.timeline.last > 0) player.play();
  else player.changed();
  setTimeout(() => !player.playing && player.pause(), 150); // the first image has the model's own size, to appear early
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
    notify(error.message);
  });
}
