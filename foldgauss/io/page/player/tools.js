// Tools that select: brush, rectangle, lasso, polygon and eyedropper. Points are device pixels of the canvas.
import { element, on } from "./elements.js";
import { Picker } from "./picking.js";

export const TOOLS = ["hand", "brush", "rectangle", "lasso", "polygon", "eyedropper", "transform"];
const CLOSE = 8; // CSS pixels: a click closer to the polygon's first corner closes it
const STEP = 4; // pixels of the video that growing and shrinking take

/** How a selection is combined with the old one: by keys, else as the panel says. */
const howOf = (event, chosen) => (event.shiftKey && event.altKey ? "intersect" : event.shiftKey ? "add" : event.altKey ? "subtract" : chosen);

export class Tools {
  constructor(player, screen) {
    Object.assign(this, { player, screen, name: "brush", how: "new", points: [], picker: new Picker() });
    for (const name of ["radius", "tolerance"])
      for (const end of ["", "-value"]) on(`${name}${end}`, "input", () => this.set(name, Number(element(`${name}${end}`).value)));
    [this.radius, this.tolerance] = [28, 15];
  }

  set(name, value) {
    if (!(value > 0)) return;
    this[name] = value;
    this.player.onChange();
  }

  choose(name) {
    this.cancel();
    this.name = name;
    this.player.changed();
  }

  /** Whether the tool takes what the pointer does on the canvas. */
  get isSelecting() {
    return this.name !== "hand" && this.name !== "transform";
  }

  get drawsOutline() {
    return ["rectangle", "lasso", "polygon"].includes(this.name);
  }

  // ---------------------------------------------------------------------------------------------- pointers

  down(point, event) {
    this.pressed = true;
    this.keys = howOf(event, this.how);
    if (this.name === "brush") this.beginStroke(point);
    else if (this.name === "eyedropper") this.pick(point);
    else if (this.name === "polygon") this.addCorner(point);
    else this.points = [point];
    this.player.onChange();
  }

  drag(point) {
    if (!this.pressed) return this.hover(point);
    if (this.name === "brush") this.paint(point);
    if (this.name === "rectangle") this.points = [this.points[0], point];
    if (this.name === "lasso") this.points.push(point);
    this.player.onChange();
  }

  /** The polygon's next corner follows the pointer. */
  hover(point) {
    this.at = point;
    if (this.name === "polygon" && this.points.length) this.player.onChange();
  }

  up() {
    if (!this.pressed) return;
    this.pressed = false;
    if (this.name === "brush") this.player.editing.endStroke();
    if (this.name === "rectangle" || this.name === "lasso") this.finish();
  }

  /** A key in place of the pointer: a dab, a color, or a corner; the second corner ends a rectangle. */
  tap(point, event) {
    if (this.name === "rectangle" && this.points.length) {
      this.points = [this.points[0], point];
      return this.finish();
    }
    if (this.name === "lasso" || this.name === "polygon") {
      this.keys = howOf(event, this.how);
      return this.addCorner(point);
    }
    this.down(point, event);
    if (this.name === "rectangle") this.pressed = false;
    else this.up();
  }

  cancel() {
    this.points = [];
    this.pressed = false;
    this.player.editing.endStroke();
    this.player.onChange();
  }

  addCorner(point) {
    const [first] = this.points, near = CLOSE * this.screen.ratio;
    if (first && this.points.length > 2 && Math.hypot(point[0] - first[0], point[1] - first[1]) < near) return this.finish();
    this.points.push(point);
    this.player.onChange();
  }

  removeCorner() {
    this.points.pop();
    this.player.onChange();
  }

  /** The outline as drawn, in device pixels. */
  get outline() {
    if (this.name === "rectangle" && this.points.length === 2) return corners(this.points);
    return this.name === "polygon" && this.points.length && this.at ? [...this.points, this.at] : this.points;
  }

  // -------------------------------------------------------------------------------------------- selections

  /** A point in model space, and pixels per unit. */
  toModel([x, y]) {
    const { view, numPanes } = this.player;
    return view.toModel(x, y, view.paneAt(x, y, numPanes));
  }

  get isReady() {
    return this.player.segments.missing === undefined; // else the image shown is of another time
  }

  select(indices, how) {
    const { player } = this, { state, lead } = player, found = new Uint8Array(state.model.num);
    for (const i of indices) found[i] = 1;
    player.editing.select(lead.number, lead.base, found, how);
  }

  beginStroke(point) {
    if (!this.isReady) return;
    this.player.editing.beginStroke(this.player.lead.number, this.player.base);
    this.paint(point);
  }

  paint(point) {
    const { player } = this, { editing } = player;
    if (!this.isReady) return;
    if (editing.draft?.number !== player.lead.number) { // a new segment begins a new stroke
      editing.endStroke();
      editing.beginStroke(player.lead.number, player.base);
    }
    const [x, y, unit] = this.toModel(point), radius = (this.radius * this.screen.ratio) / unit;
    editing.paint(this.picker.inCircle(player.state, player.ownTime, x, y, radius), this.keys === "subtract");
    player.changed();
  }

  /** Select what is in the outline. */
  finish() {
    const points = (this.name === "rectangle" && this.points.length === 2 ? corners(this.points) : this.points).map((point) => this.toModel(point).slice(0, 2));
    this.points = [];
    if (points.length > 2 && this.isReady) this.select(this.picker.inOutline(this.player.state, this.player.ownTime, points), this.keys);
    this.player.onChange();
  }

  pick(point) {
    if (!this.isReady) return;
    const { player } = this, [x, y] = this.toModel(point), color = this.picker.colorAt(player.state, player.ownTime, x, y);
    this.select(this.picker.ofColor(player.state, color, this.tolerance), this.keys);
  }

  selectAll() {
    this.select(this.player.state.selected.keys(), "new");
  }

  selectNone() {
    if (Object.keys(this.player.editing.selection).length) this.player.editing.selectNone();
  }

  invert() {
    const { selected } = this.player.state, others = [];
    for (let i = 0; i < selected.length; i++) if (!selected[i]) others.push(i);
    this.select(others, "new");
  }

  get distance() {
    return STEP / Math.max(...this.player.base.header.size);
  }

  grow() {
    this.select(this.picker.around(this.player.state, this.player.ownTime, this.distance), "add");
  }

  shrink() {
    this.select(this.picker.border(this.player.state, this.player.ownTime, this.distance), "subtract");
  }
}

const corners = ([[ax, ay], [bx, by]]) => [[ax, ay], [bx, ay], [bx, by], [ax, by]];
