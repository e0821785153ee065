// The player: position in time, display mode and edits, and when to render.
import { Originals } from "./originals.js";
import { WHAT } from "./renderer.js";
import { View, common } from "./view.js";

export const SPEEDS = [1 / 16, 1 / 8, 1 / 4, 1 / 2, 1, 2];
const TINT = [1, 0.58, 0.2];
const MOST_PIXELS = 6e6;
const SLOW = 1 / 27, FAST = 1 / 50; // seconds per image: render fewer pixels, more pixels

/** Edits of the selected Gaussians. `front` null: in front if there are copies. */
const UNCHANGED = { vanish: false, front: null, scale: 1, copies: 1, offset: 0.2 };

export class Player {
  constructor(canvas, renderer, segments, onChange) {
    this.canvas = canvas;
    this.segments = segments;
    this.onChange = onChange;
    this.timeline = segments.timeline;
    this.renderer = renderer;
    this.goTo(0);
    this.view = new View(this.model.header.size);
    renderer.check(this.model);
    segments.check = (model) => renderer.check(model);
    segments.onReady = () => {
      this.goTo(this.position);
      this.changed();
    };
    this.originals = new Originals(() => this.invalidate());
    Object.assign(this, { playing: false, speed: 1, loop: true });
    Object.assign(this, { mode: "model", split: 0.5, background: [0, 0, 0], brushing: false, edit: { ...UNCHANGED } });
    Object.assign(this, { quality: 0.1, alive: 0, renderTimes: [], waiting: false, before: 0, pace: 0 });
  }

  // ---------------------------------------------------------------------------------------------- time

  /** Set the position; the previous image stays until its segments are decoded. */
  goTo(position) {
    this.position = position;
    this.time = this.timeline.timeAt(position);
    this.segments.goTo(position);
    this.seen = this.segments.parts() ?? this.seen;
    this.lead = this.seen.reduce((one, other) => (other.weight > one.weight ? other : one));
  }

  /** Go to a position in frames; fractions are times between frames. */
  seekPosition(position) {
    this.goTo(Math.min(Math.max(position, 0), this.timeline.last));
    this.changed();
  }

  /** Go to a time of the clip, 0 to 1; fulfilled when its segments are decoded. */
  seek(time) {
    this.seekPosition(this.segments.positionOf(time));
    return this.segments.ready();
  }

  /** The model of the segment with the largest weight, and its selection. */
  get model() {
    return this.lead.model;
  }

  get selection() {
    return this.lead.selection;
  }

  step(frames) {
    this.pause();
    const next = frames > 0 ? Math.floor(this.position + 1e-6) + frames : Math.ceil(this.position - 1e-6) + frames;
    this.seekPosition(next);
  }

  play() {
    if (this.position >= this.timeline.last) this.seekPosition(0);
    [this.playing, this.before] = [true, 0];
    this.changed();
  }

  pause() {
    this.playing = false;
    this.quality = 1;
    this.changed();
  }

  toggle() {
    if (this.playing) this.pause();
    else this.play();
  }

  advance(now) {
    const passed = this.before ? Math.min((now - this.before) / 1000, 0.25) : 0, { last } = this.timeline;
    this.before = now;
    this.adapt(passed);
    if (this.segments.missing !== undefined) return; // wait until it is decoded
    const next = this.position + passed * this.timeline.fps * this.speed, rest = this.rest ?? 0;
    let to = next;
    this.rest = 0;
    if (next > last && !this.loop) {
      this.pause();
      return this.seekPosition(last);
    }
    if (next > last && rest + next - last < 1) [to, this.rest] = [last, rest + next - last]; // the last frame is shown for its full duration
    else if (next > last) to = 0;
    this.goTo(to);
  }

  /** Adapt the resolution to the frame rate: down to the model's own size, or up to the screen's. */
  adapt(passed) {
    if (passed <= 0) return;
    this.pace += 0.15 * (passed - this.pace);
    if (this.pace > SLOW) this.quality = Math.max(0.95 * this.quality, 0.1);
    else if (this.pace < FAST) this.quality = Math.min(1.03 * this.quality, 1);
  }

  // ----------------------------------------------------------------------------------------- rendering

  changed() {
    this.onChange();
    this.invalidate();
  }

  /** Schedule one rendering. */
  invalidate() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame((now) => {
      this.waiting = false;
      if (this.playing) this.advance(now);
      this.draw();
      if (this.playing && this.segments.next) this.renderer.take(this.segments.next); // upload it before it is needed
      this.renderTimes = [...this.renderTimes.filter((own) => now - own < 1000), now];
      this.onChange();
      if (this.playing) this.invalidate();
    });
  }

  resize(width, height) {
    [this.canvas.width, this.canvas.height] = this.view.area = [width, height];
    this.draw();
    this.onChange();
  }

  get hasOriginal() {
    return this.originals.num > 0;
  }

  get numPanes() {
    return this.mode === "side" ? 2 : 1;
  }

  /** What each pane shows: model, original or both. */
  get shown() {
    return { side: ["original", "model"] }[this.mode] ?? [this.mode];
  }

  draw() {
    const { renderer, view } = this, [width, height] = view.area;
    if (renderer.gl.isContextLost() || width < 2 || height < 2) return;
    if (this.mode !== "model") {
      const image = this.originals.at(Math.min(Math.round(this.position), this.originals.num - 1));
      if (image) renderer.setOriginal(image);
    }
    const panes = view.panes(this.numPanes);
    const visible = panes.map((pane) => common(view.frameIn(pane), pane));
    const place = this.shown.findIndex((what) => what !== "original");
    const inTarget = place < 0 ? [0, 0, 1, 1] : this.drawModel(view.frameIn(panes[place]), visible[place]);
    renderer.clear(width, height);
    panes.forEach((pane, k) => this.show(this.shown[k], view.frameIn(pane), visible[k], inTarget));
  }

  /** Render the visible part of the frame; returns its rectangle in the target. */
  drawModel(frame, visible) {
    const least = 1 / frame.scale; // the model's own resolution
    const most = Math.sqrt(MOST_PIXELS / Math.max(visible.width * visible.height, 1));
    const k = Math.min(Math.max(this.quality, least), Math.max(most, Math.min(least, 1)));
    const size = [visible.width, visible.height].map((own) => Math.max(Math.ceil(own * k), 1));
    const middle = [frame.x + frame.width / 2 - visible.x, frame.y + frame.height / 2 - visible.y];
    this.drawTo({
      width: size[0], height: size[1], unit: k * Math.max(frame.width, frame.height), origin: middle.map((own) => k * own),
      // The low-pass filter of the fit, in the model's pixels, whatever their size here.
      lowPass: this.model.header.options.low_pass * Math.max(k * frame.scale, 1) ** 2,
    });
    return [0, 0, (visible.width * k) / size[0], (visible.height * k) / size[1]];
  }

  drawTo(target) {
    const { scale, offset } = this.edit, highlight = this.brushing ? 0.65 : 0;
    this.alive = 0;
    const parts = this.seen.map(({ model, selection, time, weight }) => {
      const { list, alive } = selection.instances(time, { ...this.edit, front: this.inFront });
      const edit = { scale, pivot: selection.middle(time), shift: [offset, 0], highlight, tint: TINT };
      this.alive += alive;
      return { model, instances: list, time, weight, edit };
    });
    this.renderer.draw(parts, target);
  }

  /** Show one pane. */
  show(what, frame, visible, inTarget) {
    if (what !== "slider") return this.put(WHAT[what], frame, visible, visible, inTarget);
    const middle = frame.x + this.split * frame.width, far = 1e6;
    const left = { x: -far, y: -far, width: far + middle, height: 2 * far }, right = { ...left, x: middle, width: far };
    this.put(WHAT.original, frame, visible, common(visible, left), inTarget);
    this.put(WHAT.model, frame, visible, common(visible, right), inTarget);
  }

  put(what, frame, visible, part, inTarget) {
    const [width, height] = this.view.area;
    if (part.width <= 0 || part.height <= 0) return;
    const fraction = (whole) => [
      (part.x - whole.x) / whole.width, (part.y - whole.y) / whole.height, part.width / whole.width, part.height / whole.height,
    ];
    const of = fraction(visible), target = [of[0] * inTarget[2], of[1] * inTarget[3], of[2] * inTarget[2], of[3] * inTarget[3]];
    this.renderer.put(what, fraction({ x: 0, y: 0, width, height }), fraction(frame), target, this.background);
  }

  /** The image at this time as the engines of foldgauss render it, width x height: red, green, blue, 255. */
  pixels(width, height) {
    if (this.segments.missing !== undefined) throw new Error("This time is still being decoded: await seek(t) first.");
    const [rows, columns] = this.model.header.size, aspect = rows / columns;
    const unit = Math.max(height / Math.min(1, aspect), width / Math.min(1, 1 / aspect));
    const lowPass = this.model.header.options.low_pass;
    this.drawTo({ width, height, unit, origin: [width / 2, height / 2], lowPass });
    return this.renderer.read(this.background);
  }

  /** Images rendered in the last second. */
  get rate() {
    return this.renderTimes.length;
  }

  // ------------------------------------------------------------------------------------------ the brush

  beginStroke() {
    this.stroke = this.selection;
    this.stroke.begin();
  }

  endStroke() {
    if (this.stroke?.strokes.at(-1)?.length === 0) this.stroke.strokes.pop();
    this.stroke = null;
  }

  /** Select under the brush, at a point of the screen with a radius, in device pixels. */
  paint(x, y, radius, erase) {
    if (this.segments.missing !== undefined) return; // the image shown is of another time
    if (this.stroke !== this.selection) { // a new segment begins a new stroke
      this.endStroke();
      this.beginStroke();
    }
    const pane = this.view.paneAt(x, y, this.numPanes), [atX, atY, unit] = this.view.toModel(x, y, pane);
    this.selection.paint(this.lead.time, atX, atY, radius / unit, erase, this.edit.vanish);
    this.changed();
  }

  get inFront() {
    return this.edit.front ?? this.edit.copies > 1;
  }

  resetEdit() {
    this.segments.clear();
    this.edit = { ...UNCHANGED };
    this.changed();
  }

  /** Follow the selection through its segment; returns the number of Gaussians added. */
  async follow(onProgress) {
    const { selection, time, timeline } = this.lead, before = selection.count;
    await selection.follow(time, timeline.times, onProgress);
    return selection.count - before;
  }
}
