// The clip's segments: their weights at each position, and their models, decoded on demand. A single model is one segment.
import { place } from "./gaussians.js";
import { Timeline } from "./timeline.js";

/** Most Gaussians held decoded, some two hundred bytes each, besides the visible segments and their neighbors. */
const MOST_HELD = 2e6;
const CLOSE = 1e-6; // frames: a position closer to a frame is that frame

const clampUnit = (x) => Math.min(Math.max(x, 0), 1);

/** Progress of the fade from the previous segment, 0 to 1. */
function fadeProgress(spans, number, position) {
  if (number === 0) return 1;
  const { first } = spans[number], stop = spans[number - 1].first + spans[number - 1].num_frames;
  if (first === stop) return position >= first - 0.5 ? 1 : 0; // a cut
  return clampUnit((position - first + 1) / (stop - first + 1));
}

/** The visible segments at a frame position, in order, with weights, as in SegmentedVideo.weights. */
export function weights(spans, position) {
  const seen = [];
  let number = spans.findLastIndex((span) => span.first < position + 1);
  for (let left = 1; left > 0; number--) {
    const fraction = fadeProgress(spans, number, position); // the later ones cover the earlier ones
    if (fraction > 0) seen.unshift([number, left * fraction]);
    left *= 1 - fraction;
  }
  return seen;
}

export class Segments {
  /** `lead`: the first segment's model; `spans` null: it is the whole clip, with its own frame times. */
  constructor(lead, spans, decoder) {
    this.spans = spans ?? [{ first: 0, num_frames: lead.times.length, num_gaussians: lead.num }];
    this.even = spans !== null; // frames are evenly spaced in the clip's time
    this.decoder = decoder;
    this.most = MOST_HELD;
    this.total = this.spans.reduce((sum, span) => sum + span.num_gaussians, 0);
    this.held = new Map();
    this.waiting = []; // promises to settle when the visible segments are decoded
    this.check = () => {}; // throws if a model cannot be rendered
    this.onReady = this.onError = this.onPart = this.onWhole = () => {};
    decoder.onPart = (part) => this.take(part);
    const own = this.hold(0, lead), numFrames = this.spans.at(-1).first + this.spans.at(-1).num_frames;
    const times = () => Array.from({ length: numFrames }, (_, k) => k / Math.max(numFrames - 1, 1));
    this.timeline = spans ? new Timeline(times(), lead.header.fps, lead.header.metadata?.frame_seconds) : own.timeline;
    this.begun = false;
    this.goTo(0);
  }

  /** Start decoding ahead, once the first image is shown. */
  begin() {
    this.begun = true;
    this.work();
  }

  hold(number, model) {
    const own = { base: model, timeline: new Timeline(model.times, model.header.fps, model.header.metadata?.frame_seconds) };
    this.held.set(number, own);
    return own;
  }

  /** The frame position of a time of the clip. */
  positionOf(time) {
    const { even, timeline } = this, position = even ? clampUnit(time) * timeline.last : timeline.positionOf(time);
    const nearest = Math.round(position);
    return Math.abs(position - nearest) < CLOSE ? nearest : position;
  }

  /** Set the position and decode the visible segments first, then the next, then as many as may be held. */
  goTo(position) {
    this.position = position;
    if (!this.even) this.decoder.tell((this.time = this.timeline.timeAt(position)));
    this.seen = weights(this.spans, position).map(([number]) => number);
    const wanted = this.order(this.seen);
    for (const number of this.held.keys()) if (!wanted.includes(number)) this.held.delete(number);
    this.wanted = wanted;
    this.work();
  }

  /** The segments to hold, in the order of decoding. */
  order(seen) {
    const { length } = this.spans, low = seen[0], high = seen.at(-1), order = [...seen, (high + 1) % length, low - 1];
    for (let away = 2; away < length; away++) order.push(high + away, low - away);
    let sum = 0;
    return [...new Set(order)].filter((number) => number >= 0 && number < length).filter((number, k) => {
      sum += this.spans[number].num_gaussians;
      return sum <= this.most || k < seen.length + 2;
    });
  }

  /** The first visible segment that is not decoded yet, if any. */
  get missing() {
    return this.seen.find((number) => !this.held.has(number));
  }

  /** The visible models, as in the file, with their weights and times; null while one of them is being decoded. */
  parts() {
    if (this.missing !== undefined) return null;
    return weights(this.spans, this.position).map(([number, weight]) => {
      const own = this.held.get(number);
      return { ...own, number, weight, time: own.timeline.timeAt(this.position - this.spans[number].first) };
    });
  }

  /** The number of the next segment, if it is decoded. */
  get next() {
    const number = (this.seen.at(-1) + 1) % this.spans.length;
    return this.held.has(number) ? number : undefined;
  }

  /** The number of Gaussians of each segment. */
  get counts() {
    return this.spans.map((span) => span.num_gaussians);
  }

  /** Whether what is visible is decoded. */
  get isReady() {
    return this.missing === undefined && !this.decoder.lacks(this.time);
  }

  /** Fulfilled when what is visible is decoded. */
  ready() {
    if (this.error) return Promise.reject(this.error);
    if (this.isReady) return Promise.resolve();
    return new Promise((resolve, reject) => this.waiting.push({ resolve, reject }));
  }

  /** Decode the next segment wanted, one at a time; a visible one interrupts one that is not. */
  work() {
    if (this.isReady) for (const { resolve } of this.waiting.splice(0)) resolve();
    if (this.missing === undefined && !this.begun) return;
    const next = this.wanted.find((number) => !this.held.has(number));
    if (this.error || (next !== undefined && next === this.decoding)) return;
    if (this.decoding !== undefined) {
      if (!this.seen.includes(next) || this.seen.includes(this.decoding)) return;
      this.decoder.stop();
    }
    this.decoding = next;
    if (next === undefined) return this.decoder.isWhole && this.decoder.stop();
    const job = (this.job = this.decoder.decode(next, () => {}));
    job.then((model) => this.job === job && this.accept(next, model)).catch((error) => this.job === job && this.failed(error));
  }

  /** Take a part of the single model, null for a chunk that is lost. */
  take(part) {
    if (part) place(this.held.get(0).base, part);
    this.work();
    this.onPart(part);
    if (this.decoder.isWhole) this.onWhole();
  }

  accept(number, model) {
    this.decoding = undefined;
    this.check(model);
    if (this.wanted.includes(number)) this.hold(number, model);
    this.work();
    if (this.seen.includes(number)) this.onReady();
  }

  failed(error) {
    this.error = error;
    this.decoder.stop();
    for (const { reject } of this.waiting.splice(0)) reject(error);
    this.onError(error);
  }
}
