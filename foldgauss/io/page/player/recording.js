// Recording what the model shows: a video by the browser's own encoder, in real time, or a picture.
import { element, on, put, toast } from "./elements.js";
import { download } from "./files.js";

const FORMATS = [["video/webm;codecs=vp9", "webm"], ["video/webm", "webm"], ["video/mp4", "mp4"]];
const BITS_PER_PIXEL = 0.2, LEAST_BITS = 2e6, MOST_BITS = 6e7;
const LONGEST_START = 3000, LEAST_PAUSE = 4; // milliseconds, in which the encoder takes the frame

const pause = (milliseconds) => new Promise((next) => setTimeout(next, milliseconds));

export class Recording {
  constructor(player, files) {
    Object.assign(this, { player, files, running: false });
    on("record", "click", () => (this.running ? (this.stopped = true) : this.run()));
    on("picture", "click", () => this.savePicture());
    const supported = typeof MediaRecorder !== "undefined" && FORMATS.find(([type]) => MediaRecorder.isTypeSupported(type));
    [this.type, this.suffix] = supported || [];
    element("record").disabled = !supported;
    if (!supported) put("record-about", "This browser records no video. Use foldgauss render.");
    else if (this.suffix === "mp4") put("record-about", "MP4; it takes as long as it plays");
  }

  /** Describe a model that was opened. */
  describe() {
    const { base, timeline } = this.player;
    element("record-height").value = base.header.size[0];
    for (const name of ["first", "last"]) element(`record-${name}`).max = timeline.last;
    element("record-first").value = 0;
    element("record-last").value = timeline.last;
  }

  /** Width and height, both even, as encoders need them. */
  get size() {
    const [rows, columns] = this.player.base.header.size, height = Math.min(Math.max(Number(element("record-height").value) || rows, 16), 4320);
    return [(height * columns) / rows, height].map((own) => 2 * Math.max(Math.round(own / 2), 1));
  }

  /** Draw the image of the current position, without marks, into a canvas. */
  draw(context, width, height) {
    const { player } = this, { highlighting } = player;
    player.highlighting = false;
    const bytes = player.pixels(width, height);
    player.highlighting = highlighting;
    context.putImageData(new ImageData(new Uint8ClampedArray(bytes.buffer), width, height), 0, 0);
  }

  canvas() {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = this.size;
    return canvas;
  }

  async savePicture() {
    const canvas = this.canvas(), [width, height] = [canvas.width, canvas.height], { player, files } = this;
    this.draw(canvas.getContext("2d"), width, height);
    player.invalidate();
    const frame = Number(player.position.toFixed(2));
    canvas.toBlob((picture) => download(picture, `${files.stem}-${frame}.png`), "image/png");
  }

  /** Frames from one to another at a speed. */
  get range() {
    const { last } = this.player.timeline, [first, stop] = ["first", "last"].map((name) => Math.min(Math.max(Number(element(`record-${name}`).value) || 0, 0), last));
    return { first: Math.min(first, stop), last: Math.max(first, stop), speed: Math.min(Math.max(Number(element("record-speed").value) || 1, 1 / 64), 16) };
  }

  /** Start a recorder; its encoder takes a while, in which frames would be lost. */
  async start(recorder, source) {
    let started = false;
    recorder.onstart = () => (started = true);
    recorder.start();
    for (const begun = performance.now(); !started && performance.now() - begun < LONGEST_START; await pause(10)) source.requestFrame();
  }

  async run() {
    const { player } = this, canvas = this.canvas(), [width, height] = [canvas.width, canvas.height], context = canvas.getContext("2d");
    const { first, last, speed } = this.range, rate = player.timeline.fps * speed, before = player.position, parts = [];
    const { timeline } = player, begin = timeline.secondOf(first), length = (timeline.secondOf(last + 1) - begin) / speed;
    const tick = 1000 / (timeline.seconds ? 60 : Math.min(Math.max(rate, 24), 60)); // with own times, frames may follow each other quickly
    player.pause();
    const stream = canvas.captureStream(0), [track] = stream.getVideoTracks(), pixels = width * height * (1000 / tick);
    const source = track.requestFrame ? track : stream; // in Firefox it is the stream's
    const recorder = new MediaRecorder(stream, { mimeType: this.type, videoBitsPerSecond: Math.min(Math.max(BITS_PER_PIXEL * pixels, LEAST_BITS), MOST_BITS) });
    recorder.ondataavailable = (event) => parts.push(event.data);
    const ended = new Promise((done) => (recorder.onstop = done)), at = async (position) => {
      player.goTo(position); // the screen need not show it
      await player.segments.ready();
      this.draw(context, width, height);
      source.requestFrame();
    };
    [this.running, this.stopped] = [true, false];
    try {
      await at(first);
      await this.start(recorder, source);
      const begun = performance.now();
      for (let seconds = 0; seconds < length && !this.stopped; seconds = (performance.now() - begun) / 1000) {
        const now = performance.now();
        const position = timeline.positionAt(begin + seconds * speed);
        await at(Math.min(rate < 24 ? position : Math.floor(position + 1e-6), last)); // slow motion has times between frames
        put("record", `Recording ${Math.round((100 * seconds) / length)} % — stop`);
        await pause(Math.max(tick - (performance.now() - now), LEAST_PAUSE));
      }
      if (!this.stopped) await at(last); // where the computer is slow, frames are left out, but never this one
      for (let k = 0; k < 3; k++, await pause(tick)) source.requestFrame();
      recorder.stop();
      await ended;
      download(new Blob(parts, { type: this.type }), `${this.files.stem}.${this.suffix}`);
      if (this.stopped) toast("Recorded up to here.");
    } catch (error) {
      toast(`Not recorded: ${error.message}`, 8000);
    } finally {
      this.running = false;
      track.stop();
      put("record", "Record a video");
      player.seekPosition(before);
    }
  }
}
