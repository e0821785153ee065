// Learned frame times: from frame positions to the model's time, as in foldgauss.video.models.frame_times.

const CUT_RATIO = 6; // an interval longer than the median one by this factor is a cut

/** The times of the frames, 0 to 1, from the logits of their intervals. */
export function frameTimes(logits) {
  const largest = logits.reduce((a, b) => Math.max(a, b), -Infinity);
  const weights = Array.from(logits, (own) => Math.exp(own - largest));
  const total = weights.reduce((a, b) => a + b, 0);
  let sum = 0;
  return [0, ...weights.map((own) => Math.min((sum += own) / total, 1))];
}

function median(values) {
  const sorted = [...values].sort((a, b) => a - b), middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

/** Times of a clip's frame positions: 2.5 is half way from frame 2 to frame 3. */
export class Timeline {
  /** `seconds`: when the frames are shown, and the end, where they are not evenly spaced at `fps`; ignored unless they fit and rise from 0. */
  constructor(times, fps, seconds) {
    this.times = times;
    this.fps = fps;
    this.last = times.length - 1;
    const fits = Array.isArray(seconds) && seconds.length === times.length + 1 && seconds[0] === 0 && seconds.every((own, k) => Number.isFinite(own) && (k === 0 || own > seconds[k - 1]));
    this.seconds = fits ? seconds : null;
    const intervals = times.slice(1).map((own, k) => own - times[k]);
    const bound = intervals.length ? CUT_RATIO * median(intervals) : 0;
    this.isCut = intervals.map((own) => own > bound);
  }

  /** The second at which a position is shown; the last frame ends at `last` + 1. */
  secondOf(position) {
    const { seconds, fps, last } = this, end = last + 1, k = Math.min(Math.floor(position), last);
    if (!seconds || position < 0) return position / fps;
    if (position > end) return seconds[end] + (position - end) / fps;
    return seconds[k] + (position - k) * (seconds[k + 1] - seconds[k]);
  }

  /** The position shown at a second, the inverse of `secondOf`. */
  positionAt(second) {
    const { seconds, fps, last } = this, end = last + 1;
    if (!seconds || second < 0) return second * fps;
    return second > seconds[end] ? end + (second - seconds[end]) * fps : place(seconds, second);
  }

  /** The model's time of a position; in the gap of a cut that of the nearer frame. */
  timeAt(position) {
    const held = Math.min(Math.max(position, 0), this.last), k = Math.min(Math.floor(held), this.last - 1);
    if (this.last === 0) return this.times[0];
    const fraction = this.isCut[k] ? Math.round(held - k) : held - k;
    return this.times[k] + fraction * (this.times[k + 1] - this.times[k]);
  }

  /** The position of a time of the model. */
  positionOf(time) {
    return this.last === 0 ? 0 : place(this.times, time);
  }
}

/** The position of a value among rising ones, two at least: 2.5 is half way from number 2 to number 3. */
function place(rising, value) {
  let low = 0, high = rising.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (rising[middle] <= value) low = middle; else high = middle;
  }
  const span = rising[high] - rising[low];
  return low + (span > 0 ? Math.min(Math.max((value - rising[low]) / span, 0), 1) : 0);
}
