// The player: position in time, display mode, the edited Gaussians of that time, and when to render.
import { Editing } from "./editing.js";
import { alive } from "./gaussians.js";
import { Originals } from "./originals.js";
import { SELECTED, WHAT } from "./renderer.js";
import { View, common } from "./view.js";

export const SPEEDS = [1 / 16, 1 / 8, 1 / 4, 1 / 2, 1, 2];
const HIGHLIGHT = 0.65;
const COLORING = ["recolor", "opacity"];
const MOST_PIXELS = 6e6;
const SLOW = 1 / 27, FAST = 1 / 50; // seconds per image: render fewer pixels, more pixels

export class Player {
  constructor(canvas, renderer, onChange) {
    Object.assign(this, { canvas, renderer, onChange });
    Object.assign(this, { playing: false, speed: 1, loop: true, quality: 0.1, alive: 0, renderTimes: [], waiting: false });
    Object.assign(this, { mode: "model", split: 0.5, background: [0, 0, 0], highlighting: false, before: 0, pace: 0 });
    this.buffer = new Uint32Array(0);
  }

  /** Show a model: the segments of a page or a file, with the original's frames or null. */
  open(segments, originals = null) {
    this.renderer.check(segments.held.get(0).base);
    this.pause();
    this.segments = segments;
    this.timeline = segments.timeline;
    this.originals = originals ?? new Originals([], () => {});
    this.originals.onReady = () => this.invalidate();
    this.mode = "model";
    this.highlighting &&= segments.decoder.isWhole; // what has not arrived cannot be edited
    this.editing = new Editing(segments.counts);
    this.editing.onChange = () => this.changed();
    this.seen = this.lead = null;
    this.goTo(0);
    this.view = new View(this.base.header.size, this.view?.area);
    segments.check = (model) => this.renderer.check(model);
    segments.onPart = (part) => {
      if (part) this.renderer.update(this.base, part);
      this.changed();
    };
    segments.onReady = () => {
      this.goTo(this.position);
      this.changed();
    };
  }

  // ---------------------------------------------------------------------------------------------- time

  /** Set the position; the previous image stays until its segments are decoded. */
  goTo(position) {
    this.position = position;
    this.time = this.timeline.timeAt(position);
    this.segments.goTo(position);
    this.seen = this.segments.parts() ?? this.seen;
    this.lead = this.seen.reduce((one, other) => (other.weight > one.weight ? other : one));
    this.editing.forget(this.segments.held);
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

  /** The model, as in the file, of the segment with the largest weight; its edited state; the time in it. */
  get base() {
    return this.lead.base;
  }

  get state() {
    return this.editing.stateOf(this.lead.number, this.lead.base);
  }

  get ownTime() {
    return this.lead.time;
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
    if (this.segments) this.changed();
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
    const { timeline } = this, next = timeline.positionAt(timeline.secondOf(this.position) + passed * this.speed), rest = this.rest ?? 0;
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
      if (this.playing && this.segments.next !== undefined) this.renderer.take(this.stateOf(this.segments.next).model); // before it is needed
      this.renderTimes = [...this.renderTimes.filter((own) => now - own < 1000), now];
      this.onChange();
      if (this.playing) this.invalidate();
    });
  }

  stateOf(number) {
    return this.editing.stateOf(number, this.segments.held.get(number).base);
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
      lowPass: this.base.header.options.low_pass * Math.max(k * frame.scale, 1) ** 2, isExact: !this.playing,
    });
    return [0, 0, (visible.width * k) / size[0], (visible.height * k) / size[1]];
  }

  /** Whether the selection is tinted: not after an edit of its color, which the tint would hide, until the next step. */
  get isTinted() {
    const { draft, history } = this.editing;
    return this.highlighting && (draft !== null || !COLORING.includes(history.last?.do));
  }

  drawTo(target) {
    const highlight = this.isTinted ? HIGHLIGHT : 0;
    this.alive = 0;
    const parts = this.seen.map(({ number, base, time, weight }) => {
      const state = this.editing.stateOf(number, base), instances = this.instances(state, time, highlight > 0);
      this.alive += instances.length;
      return { model: state.model, instances, time, weight, highlight };
    });
    this.renderer.draw(parts, target);
  }

  /** The Gaussians alive at a time, front to back, those selected marked on demand. */
  instances({ model, selected }, time, marked) {
    if (this.buffer.length < model.num) this.buffer = new Uint32Array(model.num);
    const list = alive(model, time, this.buffer).slice(); // several models are drawn one after another
    if (marked) for (let k = 0; k < list.length; k++) if (selected[list[k]]) list[k] += SELECTED;
    return list;
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
    const [rows, columns] = this.base.header.size, aspect = rows / columns;
    const unit = Math.max(height / Math.min(1, aspect), width / Math.min(1, 1 / aspect));
    const lowPass = this.base.header.options.low_pass;
    this.drawTo({ width, height, unit, origin: [width / 2, height / 2], lowPass, isExact: true });
    return this.renderer.read(this.background);
  }

  /** Images rendered in the last second. */
  get rate() {
    return this.renderTimes.length;
  }
}
