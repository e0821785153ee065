// Which Gaussians a brush, an outline or a color means, and which are next to those selected. Indices of a state's model.
import { Grid, extent } from "./grid.js";
import { alive, condition, lowPassOf } from "./gaussians.js";
import { deltaE, toLab } from "./lab.js";

/** Conditions the Gaussians of a model on times, in memory that is used again. */
export class Picker {
  constructor() {
    this.buffer = new Uint32Array(0);
  }

  /** The Gaussians alive at a time, conditioned, front to back. */
  at({ model }, time, wanted = () => true) {
    if (this.buffer.length < model.num) this.buffer = new Uint32Array(model.num);
    const lowPass = lowPassOf(model.header), found = [];
    for (const i of alive(model, time, this.buffer)) {
      const one = condition(model, i, time, lowPass);
      if (wanted(one)) found.push(one);
    }
    return found;
  }

  /** Those that are seen and whose centers are `inside(x, y)`, which lies within a box. */
  seenIn(state, time, inside, [left, top, right, bottom]) {
    const near = this.at(state, time, (one) => {
      const reach = extent(one);
      return one.x + reach > left && one.x - reach < right && one.y + reach > top && one.y - reach < bottom;
    });
    const grid = this.grid(near, state);
    return near.filter((one, place) => inside(one.x, one.y) && grid.isSeen(place)).map((one) => one.i);
  }

  grid(list, { model }) {
    return new Grid(list, model.header.compositing === "sum");
  }

  inCircle(state, time, x, y, radius) {
    const inside = (ownX, ownY) => Math.hypot(ownX - x, ownY - y) < radius;
    return this.seenIn(state, time, inside, [x - radius, y - radius, x + radius, y + radius]);
  }

  /** Inside an outline of points (x, y), by the even-odd rule. */
  inOutline(state, time, points) {
    const xs = points.map(([x]) => x), ys = points.map(([, y]) => y);
    const inside = (x, y) => {
      let odd = false;
      for (let k = 0, j = points.length - 1; k < points.length; j = k++) {
        const [ax, ay] = points[k], [bx, by] = points[j];
        if (ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax) odd = !odd;
      }
      return odd;
    };
    return this.seenIn(state, time, inside, [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)]);
  }

  /** The color of the picture at a point, red, green, blue. */
  colorAt(state, time, x, y) {
    const color = [0, 0, 0], { values, texels } = state.model;
    for (const [one, weight] of this.grid(this.at(state, time), state).shown(x, y))
      for (let c = 0; c < 3; c++) color[c] += weight * values[4 * texels * one.i + 8 + c];
    return color.map((own) => Math.min(own, 1));
  }

  /** Of this color to a tolerance in CIELAB, at whatever time. */
  ofColor({ model: { num, values, texels } }, color, tolerance) {
    const wanted = toLab(color), found = [];
    for (let i = 0; i < num; i++) {
      const at = 4 * texels * i + 8;
      if (deltaE(toLab([values[at], values[at + 1], values[at + 2]]), wanted) <= tolerance) found.push(i);
    }
    return found;
  }

  /** Seen at this time, not selected, and no farther than `distance` from one selected: what growing adds. */
  around(state, time, distance) {
    return this.neighbors(state, time, distance, (i) => !state.selected[i]);
  }

  /** Selected, and no farther than `distance` from one seen that is not: what shrinking removes. */
  border(state, time, distance) {
    return this.neighbors(state, time, distance, (i) => state.selected[i]);
  }

  /** Seen Gaussians that are `wanted`, next to seen ones that are not. */
  neighbors(state, time, distance, wanted) {
    const all = this.at(state, time), grid = this.grid(all, state), seen = all.filter((one, place) => grid.isSeen(place) || state.selected[one.i]);
    const square = (one) => [Math.floor(one.x / distance), Math.floor(one.y / distance)], buckets = new Map();
    for (const one of seen) {
      if (wanted(one.i)) continue;
      const key = square(one).join();
      if (!buckets.has(key)) buckets.set(key, []);
      buckets.get(key).push(one);
    }
    const isNear = (one) => {
      const [column, row] = square(one);
      for (let x = column - 1; x <= column + 1; x++)
        for (let y = row - 1; y <= row + 1; y++)
          if (buckets.get(`${x},${y}`)?.some((other) => Math.hypot(one.x - other.x, one.y - other.y) <= distance)) return true;
      return false;
    };
    return seen.filter((one) => wanted(one.i) && isNear(one)).map((one) => one.i);
  }

  /** The selection's center at a time, by opacity and area, and its box of centers; null if none of it is alive. */
  placeOf(state, time) {
    const own = this.at(state, time, (one) => state.selected[one.i]);
    if (!own.length) return null;
    const box = [Infinity, Infinity, -Infinity, -Infinity], center = [0, 0];
    let total = 0;
    for (const { x, y, opacity, first, second } of own) {
      const weight = opacity * Math.sqrt(first * second) + 1e-12;
      [box[0], box[1], box[2], box[3]] = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)];
      center[0] += weight * x;
      center[1] += weight * y;
      total += weight;
    }
    return { box, center: center.map((sum) => sum / total) };
  }
}
