// Layout of the images on the screen, with zoom and pan. Device pixels, y down.

const MOST = 64;
const GAP = 8;

export class View {
  constructor([height, width], area = [1, 1]) {
    [this.height, this.width] = [height, width];
    this.area = area;
    this.reset();
  }

  reset() {
    this.zoom = 1;
    this.pan = [0, 0];
  }

  get isReset() {
    return this.zoom === 1;
  }

  /** Panes of the screen, side by side or one above the other, whichever shows larger images. */
  panes(number) {
    const [width, height] = this.area;
    if (number === 1) return [{ x: 0, y: 0, width, height }];
    const beside = { width: (width - GAP) / 2, height }, above = { width, height: (height - GAP) / 2 };
    if (this.fit(beside) >= this.fit(above)) return [{ x: 0, y: 0, ...beside }, { x: (width + GAP) / 2, y: 0, ...beside }];
    return [{ x: 0, y: 0, ...above }, { x: 0, y: (height + GAP) / 2, ...above }];
  }

  /** Device pixels per pixel of the frame that fit the frame into the pane. */
  fit(pane) {
    return Math.max(Math.min(pane.width / this.width, pane.height / this.height), 1e-3);
  }

  /** Rectangle of the frame, which may extend beyond the pane. */
  frameIn(pane) {
    const scale = this.fit(pane) * this.zoom, width = scale * this.width, height = scale * this.height;
    const held = (pan, size, available) => Math.min(Math.max(pan, -Math.max(size - available, 0) / 2), Math.max(size - available, 0) / 2);
    const pan = [held(this.pan[0], width, pane.width), held(this.pan[1], height, pane.height)];
    const x = pane.x + (pane.width - width) / 2 + pan[0], y = pane.y + (pane.height - height) / 2 + pan[1];
    return { x, y, width, height, scale, pan };
  }

  /** Zoom by a factor about the point (x, y). */
  zoomAt(factor, x, y, pane) {
    const zoom = Math.min(Math.max(this.zoom * factor, 1), MOST), ratio = zoom / this.zoom;
    const { pan } = this.frameIn(pane), away = [x - pane.x - pane.width / 2, y - pane.y - pane.height / 2];
    this.zoom = zoom;
    this.pan = pan.map((own, axis) => away[axis] - (away[axis] - own) * ratio);
    this.pan = this.frameIn(pane).pan;
  }

  move(dx, dy, pane) {
    this.pan = [this.pan[0] + dx, this.pan[1] + dy];
    this.pan = this.frameIn(pane).pan;
  }

  /** The pane that contains a point, else the first. */
  paneAt(x, y, number) {
    const panes = this.panes(number);
    return panes.find((own) => x >= own.x && y >= own.y && x < own.x + own.width && y < own.y + own.height) ?? panes[0];
  }

  /** A point of the screen in model space, and the scale in pixels per unit. */
  toModel(x, y, pane) {
    const frame = this.frameIn(pane), unit = Math.max(frame.width, frame.height);
    return [(x - frame.x - frame.width / 2) / unit, (y - frame.y - frame.height / 2) / unit, unit];
  }

  /** A point of model space on the screen. */
  toScreen(x, y, pane) {
    const frame = this.frameIn(pane), unit = Math.max(frame.width, frame.height);
    return [frame.x + frame.width / 2 + x * unit, frame.y + frame.height / 2 + y * unit, unit];
  }
}

/** Intersection of two rectangles. */
export function common(one, other) {
  const x = Math.max(one.x, other.x), y = Math.max(one.y, other.y);
  const width = Math.min(one.x + one.width, other.x + other.width) - x;
  return { x, y, width: Math.max(width, 0), height: Math.max(Math.min(one.y + one.height, other.y + other.height) - y, 0) };
}
