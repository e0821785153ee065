// Gaussians alive at a time, their selection by brush strokes, and its propagation to other times.

const SEEN = 0.01; // least opacity times transmittance at its centre for a Gaussian to be selected
const FAR = 3.4; // standard deviations: beyond, no alpha exceeds 1 / 255
const SAME_COLOR = 0.02; // variance of colour differences
const COPIES_FROM = 28, SELECTED = 2 ** 31;

/** A Gaussian condition on a time: centre, variances along its axes with the low-pass filter's added, axes. Model units. */
export function condition(model, i, time, lowPass) {
  const { values, texels, degree, header } = model, at = 4 * texels * i;
  const u = values[at + 2] - time, tau = u / values[at + 3];
  const a = header.floor + (1 - header.floor) * Math.exp(-0.5 * header.power * tau * tau);
  let x = 0, y = 0;
  for (let k = 2 * degree - 2; k >= 0; k -= 2) {
    x = u * (x + values[at + 12 + k]);
    y = u * (y + values[at + 13 + k]);
  }
  return {
    i, x: values[at] + x, y: values[at + 1] + y,
    first: values[at + 4] ** 2 * a + lowPass, second: values[at + 5] ** 2 * a + lowPass,
    cos: values[at + 6], sin: values[at + 7], opacity: values[at + 11],
  };
}

/** Its alpha at a point. */
function alphaAt(one, x, y) {
  const dx = x - one.x, dy = y - one.y, along = one.cos * dx + one.sin * dy, across = one.cos * dy - one.sin * dx;
  return one.opacity * Math.exp(-0.5 * ((along * along) / one.first + (across * across) / one.second));
}

const extent = (one) => FAR * Math.sqrt(Math.max(one.first, one.second));

/** Similarity of the colours of two Gaussians, 0 to 1. */
function colorSimilarity(model, i, j) {
  const { values, texels } = model, at = 4 * texels * i + 8, other = 4 * texels * j + 8;
  let square = 0;
  for (let c = 0; c < 3; c++) square += (values[at + c] - values[other + c]) ** 2;
  return Math.exp((-0.5 * square) / SAME_COLOR);
}

export class Selection {
  constructor(model) {
    this.model = model;
    this.selected = new Uint8Array(model.num);
    this.count = 0;
    this.strokes = []; // indices changed by each
    this.room = new Uint32Array(model.num);
    this.lowPass = model.header.options.low_pass / Math.max(...model.header.size) ** 2;
  }

  /** Indices of the Gaussians alive at a time, in order. Valid until the next call. */
  alive(time) {
    const { room, model: { num, windows } } = this, t = Math.fround(time);
    let count = 0;
    for (let i = 0; i < num; i++) if (windows[2 * i] < t && t < windows[2 * i + 1]) room[count++] = i;
    return room.subarray(0, count);
  }

  /** Instances to render, front to back, with the edit applied, and the number of Gaussians alive. */
  instances(time, edit) {
    const alive = this.alive(time), { selected } = this;
    if (this.count === 0) return { list: alive.slice(), alive: alive.length };
    const list = [];
    const add = (wanted) => {
      for (const i of alive) {
        if (!wanted(i)) continue;
        if (!selected[i]) list.push(i);
        else if (!edit.vanish) for (let c = 0; c < edit.copies; c++) list.push(i + c * 2 ** COPIES_FROM + SELECTED);
      }
    };
    if (edit.front) {
      add((i) => selected[i]);
      add((i) => !selected[i]);
    } else add(() => true);
    return { list: Uint32Array.from(list), alive: alive.length };
  }

  begin() {
    this.strokes.push([]);
  }

  /**
   * Select, or erase, the visible Gaussians at a time whose centres are in a circle, model units. Where the selected
   * ones have vanished, those behind them are visible.
   */
  paint(time, x, y, radius, erase, vanished) {
    const { model, lowPass } = this, near = [];
    for (const i of this.alive(time)) {
      if (vanished && !erase && this.selected[i]) continue;
      const one = condition(model, i, time, lowPass);
      if (Math.hypot(one.x - x, one.y - y) < radius + extent(one)) near.push(one);
    }
    const inside = (one) => Math.hypot(one.x - x, one.y - y) < radius;
    near.forEach((one, place) => {
      if (inside(one) && (erase || one.opacity * this.transmittance(near, place) >= SEEN)) this.change(one.i, !erase);
    });
  }

  /** Transmittance at the centre of a Gaussian in a list from front to back. */
  transmittance(list, place) {
    const { x, y, opacity } = list[place];
    let transmittance = 1;
    if (this.model.header.compositing === "sum") return transmittance;
    for (let k = 0; k < place && transmittance * opacity >= SEEN; k++) transmittance *= 1 - Math.min(alphaAt(list[k], x, y), 0.99);
    return transmittance;
  }

  change(i, to) {
    if (Boolean(this.selected[i]) === to) return;
    this.selected[i] = to ? 1 : 0;
    this.count += to ? 1 : -1;
    this.strokes.at(-1).push(i);
  }

  undo() {
    for (const i of this.strokes.pop() ?? []) {
      this.selected[i] = 1 - this.selected[i];
      this.count += this.selected[i] ? 1 : -1;
    }
  }

  clear() {
    this.selected.fill(0);
    this.count = 0;
    this.strokes = [];
  }

  /** Centre of the selected Gaussians alive, weighted by opacity and area; without any the frame's. */
  middle(time) {
    let x = 0, y = 0, total = 0;
    if (this.count)
      for (const i of this.alive(time)) {
        if (!this.selected[i]) continue;
        const one = condition(this.model, i, time, this.lowPass), weight = one.opacity * Math.sqrt(one.first * one.second);
        x += weight * one.x;
        y += weight * one.y;
        total += weight;
      }
    return total > 0 ? [x / total, y / total] : [0, 0];
  }

  indices() {
    return Array.from(this.selected.keys()).filter((i) => this.selected[i]);
  }

  /**
   * Propagate the selection at one time to all frames: a new Gaussian takes the label of those of its colour that
   * cover its centre. Awaits `onProgress(fraction)` now and then, so that the page stays responsive.
   */
  async follow(time, times, onProgress) {
    const before = times.filter((t) => t < time).reverse(), after = times.filter((t) => t > time);
    const known = new Uint8Array(this.model.num); // 1: selected, 2: not selected
    for (const i of this.alive(time)) known[i] = this.selected[i] ? 1 : 2;
    let done = 0;
    for (const way of [after, before])
      for (const t of way) {
        this.labelFrame(t, known);
        if (++done % 4 === 0) await onProgress(done / (before.length + after.length));
      }
    this.begin(); // only now: strokes may be painted while it waits
    for (let i = 0; i < known.length; i++) if (known[i] === 1) this.change(i, true);
    if (this.strokes.at(-1).length === 0) this.strokes.pop();
  }

  /** Label the unknown Gaussians alive at a time by a vote of the known ones. */
  labelFrame(time, known) {
    const all = Array.from(this.alive(time), (i) => condition(this.model, i, time, this.lowPass));
    const labeled = all.filter((one) => known[one.i]), reach = labeled.map(extent), found = [];
    for (const one of all) {
      if (known[one.i]) continue;
      const votes = [0, 1e-3, 0];
      labeled.forEach((other, k) => {
        if (Math.abs(other.x - one.x) > reach[k] || Math.abs(other.y - one.y) > reach[k]) return;
        votes[known[other.i]] += alphaAt(other, one.x, one.y) * colorSimilarity(this.model, one.i, other.i);
      });
      found.push([one.i, votes[1] > votes[2] && votes[1] > 0.02 ? 1 : 2]);
    }
    for (const [i, label] of found) known[i] = label;
  }
}
