// The clip's segments: which of them are seen when, and their models, decoded as they are wanted. One model alone is one.
import { Selection } from "./selection.js";
import { Timeline } from "./timeline.js";

/** Gaussians that are held decoded, some hundred bytes each; of those seen and their neighbours all are, however many. */
const MOST_HELD = 2e6;
const CLOSE = 1e-6; // frames: a position so near to a frame is that frame

const shareOf = (x) => Math.min(Math.max(x, 0), 1);

/** How far a segment has covered the one before: 0 until it is to be seen, then up to 1. */
function risen(spans, number, position) {
  if (number === 0) return 1;
  const { first } = spans[number], stop = spans[number - 1].first + spans[number - 1].num_frames;
  if (first === stop) return position >= first - 0.5 ? 1 : 0; // a cut
  return shareOf((position - first + 1) / (stop - first + 1));
}

/** Which segments are seen at a frame position, in order, and how much of each, as SegmentedVideo.weights has it. */
export function weights(spans, position) {
  const seen = [];
  let number = spans.findLastIndex((span) => span.first < position + 1);
  for (let left = 1; left > 0; number--) {
    const share = risen(spans, number, position); // the later ones cover the earlier ones
    if (share > 0) seen.unshift([number, left * share]);
    left *= 1 - share;
  }
  return seen;
}

export class Segments {
  /** `lead`: the first one's model; `spans` null: it is the whole clip, and the clip's time is its own. */
  constructor(lead, spans, decoder) {
    this.spans = spans ?? [{ first: 0, num_frames: lead.times.length, num_gaussians: lead.num }];
    this.even = spans !== null; // of the clip's time
    this.decoder = decoder;
    this.most = MOST_HELD;
    this.total = this.spans.reduce((sum, span) => sum + span.num_gaussians, 0);
    this.held = new Map();
    this.waiting = []; // to be told when what is seen is there
    this.check = () => {}; // throws where a model cannot be drawn
    this.onReady = this.onError = () => {};
    const own = this.hold(0, lead), numFrames = this.spans.at(-1).first + this.spans.at(-1).num_frames;
    const times = () => Array.from({ length: numFrames }, (_, k) => k / Math.max(numFrames - 1, 1));
    this.timeline = spans ? new Timeline(times(), lead.header.fps) : own.timeline;
    this.begun = false;
    this.goTo(0);
  }

  /** From now on decode ahead: not before the first picture, which is to be there soon. */
  begin() {
    this.begun = true;
    this.work();
  }

  hold(number, model) {
    const own = { model, timeline: new Timeline(model.times, model.header.fps), selection: new Selection(model) };
    this.held.set(number, own);
    return own;
  }

  /** The frame position of a time of the clip. */
  positionOf(time) {
    const { even, timeline } = this, position = even ? shareOf(time) * timeline.last : timeline.positionOf(time);
    const nearest = Math.round(position);
    return Math.abs(position - nearest) < CLOSE ? nearest : position;
  }

  /** Be ready for a position: what is seen is decoded first, then what comes next, then all that may be held. */
  goTo(position) {
    this.position = position;
    this.seen = weights(this.spans, position).map(([number]) => number);
    const wanted = this.order(this.seen);
    for (const [number, { selection }] of this.held) // what is picked is not forgotten
      if (!wanted.includes(number) && !selection.count && !selection.strokes.length) this.held.delete(number);
    this.wanted = wanted;
    this.work();
  }

  /** Which are to be held, the first one first. */
  order(seen) {
    const { length } = this.spans, low = seen[0], high = seen.at(-1), order = [...seen, (high + 1) % length, low - 1];
    for (let away = 2; away < length; away++) order.push(high + away, low - away);
    let sum = 0;
    return [...new Set(order)].filter((number) => number >= 0 && number < length).filter((number, k) => {
      sum += this.spans[number].num_gaussians;
      return sum <= this.most || k < seen.length + 2;
    });
  }

  /** The first of those seen that is still being decoded, if there is one. */
  get missing() {
    return this.seen.find((number) => !this.held.has(number));
  }

  /** What is seen: models with weights and their own times; null while one of them is being decoded. */
  parts() {
    if (this.missing !== undefined) return null;
    return weights(this.spans, this.position).map(([number, weight]) => {
      const own = this.held.get(number);
      return { ...own, number, weight, time: own.timeline.timeAt(this.position - this.spans[number].first) };
    });
  }

  /** The model that plays next, where it is decoded. */
  get next() {
    return this.held.get((this.seen.at(-1) + 1) % this.spans.length)?.model;
  }

  /** Fulfilled when what is seen is there. */
  ready() {
    if (this.error) return Promise.reject(this.error);
    if (this.missing === undefined) return Promise.resolve();
    return new Promise((resolve, reject) => this.waiting.push({ resolve, reject }));
  }

  /** Decode the next one wanted, one at a time; what is not seen gives way to what is. */
  work() {
    if (this.missing === undefined) for (const { resolve } of this.waiting.splice(0)) resolve();
    if (this.missing === undefined && !this.begun) return;
    const next = this.wanted.find((number) => !this.held.has(number));
    if (this.error || (next !== undefined && next === this.decoding)) return;
    if (this.decoding !== undefined) {
      if (!this.seen.includes(next) || this.seen.includes(this.decoding)) return;
      this.decoder.stop();
    }
    this.decoding = next;
    if (next === undefined) return this.decoder.stop();
    const job = (this.job = this.decoder.decode(next, () => {}));
    job.then((model) => this.job === job && this.took(next, model)).catch((error) => this.job === job && this.failed(error));
  }

  took(number, model) {
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

  /** Let go of all that is picked. */
  clear() {
    for (const { selection } of this.held.values()) selection.clear();
  }
}
