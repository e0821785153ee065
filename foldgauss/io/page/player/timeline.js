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
  constructor(times, fps) {
    this.times = times;
    this.fps = fps;
    this.last = times.length - 1;
    const intervals = times.slice(1).map((own, k) => own - times[k]);
    const bound = intervals.length ? CUT_RATIO * median(intervals) : 0;
    this.isCut = intervals.map((own) => own > bound);
  }

  get duration() {
    return this.times.length / this.fps;
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
    if (this.last === 0) return 0;
    let low = 0, high = this.last;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (this.times[middle] <= time) low = middle; else high = middle;
    }
    const span = this.times[high] - this.times[low];
    return low + (span > 0 ? Math.min(Math.max((time - this.times[low]) / span, 0), 1) : 0);
  }
}
