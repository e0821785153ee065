// Gaussians conditioned on one time, in a grid of cells by where they reach: which cover a point, and which can be seen.
import { alphaAt } from "./gaussians.js";

const SEEN = 0.01; // least opacity times transmittance at its center for a Gaussian to be seen
const FAR = 3.4; // standard deviations: beyond, no alpha exceeds 1 / 255
const MOST_CELLS = 48; // along a side

export const extent = (one) => FAR * Math.sqrt(Math.max(one.first, one.second));

export class Grid {
  /** Of Gaussians front to back, as `condition` gives them; `sum`: they are added up, and hide nothing. */
  constructor(list, sum = false) {
    this.list = list;
    this.sum = sum;
    this.side = Math.min(Math.ceil(Math.sqrt(list.length) / 2), MOST_CELLS) || 1;
    const xs = list.map((one) => one.x), ys = list.map((one) => one.y), least = (own) => own.reduce((a, b) => Math.min(a, b), Infinity);
    const most = (own) => own.reduce((a, b) => Math.max(a, b), -Infinity);
    [this.left, this.top] = [least(xs), least(ys)];
    this.cell = [(most(xs) - this.left) / this.side || 1, (most(ys) - this.top) / this.side || 1];
    this.cells = Array.from({ length: this.side ** 2 }, () => []);
    list.forEach((one, place) => {
      const reach = extent(one), [x0, y0] = this.cellOf(one.x - reach, one.y - reach), [x1, y1] = this.cellOf(one.x + reach, one.y + reach);
      for (let y = y0; y <= y1; y++) for (let x = x0; x <= x1; x++) this.cells[y * this.side + x].push(place);
    });
  }

  cellOf(x, y) {
    const along = (own, from, cell) => Math.min(Math.max(Math.floor((own - from) / cell), 0), this.side - 1);
    return [along(x, this.left, this.cell[0]), along(y, this.top, this.cell[1])];
  }

  /** Places in the list, in order, of the Gaussians that may reach a point. */
  near(x, y) {
    if (!this.list.length) return [];
    const [column, row] = this.cellOf(x, y);
    return this.cells[row * this.side + column];
  }

  /** Whether the Gaussian at a place can be seen at its center. */
  isSeen(place) {
    const { x, y, opacity } = this.list[place];
    let left = opacity;
    for (const k of this.sum ? [] : this.near(x, y)) {
      if (k >= place || left < SEEN) break;
      left *= 1 - Math.min(alphaAt(this.list[k], x, y), 0.99);
    }
    return left >= SEEN;
  }

  /** The Gaussians at a point that show there, with the fraction that each contributes. */
  shown(x, y) {
    const found = [];
    let left = 1;
    for (const k of this.near(x, y)) {
      const alpha = Math.min(alphaAt(this.list[k], x, y), 0.99);
      if (alpha * left > 1e-3) found.push([this.list[k], alpha * left]);
      if (!this.sum) left *= 1 - alpha;
    }
    return found;
  }
}
