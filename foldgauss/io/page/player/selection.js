// Who is alive, who is picked by the brush, and who belongs to them at other times.

const SEEN = 0.01; // opacity times the light that reaches a Gaussian's centre: less is not picked
const FAR = 3.4; // deviations: beyond, no alpha is above 1 / 255
const SAME_COLOR = 0.02; // squared distance of colours that counts as a deviation
const COPIES_FROM = 28, PICKED = 2 ** 31;

/** A Gaussian at a time: centre, variances along its axes with the pixel's footprint added, axes. Model units. */
export function conditioned(model, i, time, lowPass) {
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

/** How alike the colours of two Gaussians are, 0 to 1. */
function likeness(model, i, j) {
  const { values, texels } = model, at = 4 * texels * i + 8, other = 4 * texels * j + 8;
  let square = 0;
  for (let c = 0; c < 3; c++) square += (values[at + c] - values[other + c]) ** 2;
  return Math.exp((-0.5 * square) / SAME_COLOR);
}

export class Selection {
  constructor(model) {
    this.model = model;
    this.picked = new Uint8Array(model.num);
    this.count = 0;
    this.strokes = []; // of each: who changed
    this.room = new Uint32Array(model.num);
    this.lowPass = model.header.options.low_pass / Math.max(...model.header.size) ** 2;
  }

  /** The numbers of those alive at a time, in their order. Valid until the next call. */
  alive(time) {
    const { room, model: { num, windows } } = this, t = Math.fround(time);
    let count = 0;
    for (let i = 0; i < num; i++) if (windows[2 * i] < t && t < windows[2 * i + 1]) room[count++] = i;
    return room.subarray(0, count);
  }

  /** What is drawn, front to back, and how many Gaussians are alive: picked ones as the edit says. */
  instances(time, edit) {
    const alive = this.alive(time), { picked } = this;
    if (this.count === 0) return { list: alive.slice(), alive: alive.length };
    const list = [];
    const add = (wanted) => {
      for (const i of alive) {
        if (!wanted(i)) continue;
        if (!picked[i]) list.push(i);
        else if (!edit.vanish) for (let c = 0; c < edit.copies; c++) list.push(i + c * 2 ** COPIES_FROM + PICKED);
      }
    };
    if (edit.front) {
      add((i) => picked[i]);
      add((i) => !picked[i]);
    } else add(() => true);
    return { list: Uint32Array.from(list), alive: alive.length };
  }

  begin() {
    this.strokes.push([]);
  }

  /**
   * Pick, or let go, those seen at a time whose centres are within a circle, model units. Where those picked have
   * vanished, what they hid is seen and can be picked, too.
   */
  paint(time, x, y, radius, erase, vanished) {
    const { model, lowPass } = this, near = [];
    for (const i of this.alive(time)) {
      if (vanished && !erase && this.picked[i]) continue;
      const one = conditioned(model, i, time, lowPass);
      if (Math.hypot(one.x - x, one.y - y) < radius + extent(one)) near.push(one);
    }
    const inside = (one) => Math.hypot(one.x - x, one.y - y) < radius;
    near.forEach((one, place) => {
      if (inside(one) && (erase || one.opacity * this.light(near, place) >= SEEN)) this.change(one.i, !erase);
    });
  }

  /** The light that reaches the centre of a Gaussian in a list from front to back. */
  light(list, place) {
    const { x, y, opacity } = list[place];
    let light = 1;
    if (this.model.header.compositing === "sum") return light;
    for (let k = 0; k < place && light * opacity >= SEEN; k++) light *= 1 - Math.min(alphaAt(list[k], x, y), 0.99);
    return light;
  }

  change(i, to) {
    if (Boolean(this.picked[i]) === to) return;
    this.picked[i] = to ? 1 : 0;
    this.count += to ? 1 : -1;
    this.strokes.at(-1).push(i);
  }

  undo() {
    for (const i of this.strokes.pop() ?? []) {
      this.picked[i] = 1 - this.picked[i];
      this.count += this.picked[i] ? 1 : -1;
    }
  }

  clear() {
    this.picked.fill(0);
    this.count = 0;
    this.strokes = [];
  }

  /** The middle of those picked that are alive, weighted by opacity and area; the frame's where there are none. */
  middle(time) {
    let x = 0, y = 0, total = 0;
    if (this.count)
      for (const i of this.alive(time)) {
        if (!this.picked[i]) continue;
        const one = conditioned(this.model, i, time, this.lowPass), weight = one.opacity * Math.sqrt(one.first * one.second);
        x += weight * one.x;
        y += weight * one.y;
        total += weight;
      }
    return total > 0 ? [x / total, y / total] : [0, 0];
  }

  indices() {
    return Array.from(this.picked.keys()).filter((i) => this.picked[i]);
  }

  /**
   * Pick at all frames who belongs to those picked at one: who comes anew belongs to whom its centre is covered by,
   * of its colour. `onShare` is told how far that is; awaits it, so that the page goes on.
   */
  async follow(time, times, onShare) {
    const before = times.filter((t) => t < time).reverse(), after = times.filter((t) => t > time);
    const known = new Uint8Array(this.model.num); // 1: belongs, 2: does not
    for (const i of this.alive(time)) known[i] = this.picked[i] ? 1 : 2;
    let done = 0;
    for (const way of [after, before])
      for (const t of way) {
        this.follow_to(t, known);
        if (++done % 4 === 0) await onShare(done / (before.length + after.length));
      }
    this.begin(); // not before: while it waits, strokes may be painted
    for (let i = 0; i < known.length; i++) if (known[i] === 1) this.change(i, true);
    if (this.strokes.at(-1).length === 0) this.strokes.pop();
  }

  /** Tell of everybody alive at a time whether it belongs, by those of whom it is known. */
  follow_to(time, known) {
    const all = Array.from(this.alive(time), (i) => conditioned(this.model, i, time, this.lowPass));
    const told = all.filter((one) => known[one.i]), reach = told.map(extent), found = [];
    for (const one of all) {
      if (known[one.i]) continue;
      const votes = [0, 1e-3, 0];
      told.forEach((other, k) => {
        if (Math.abs(other.x - one.x) > reach[k] || Math.abs(other.y - one.y) > reach[k]) return;
        votes[known[other.i]] += alphaAt(other, one.x, one.y) * likeness(this.model, one.i, other.i);
      });
      found.push([one.i, votes[1] > votes[2] && votes[1] > 0.02 ? 1 : 2]);
    }
    for (const [i, label] of found) known[i] = label;
  }
}
