// Pointers on the canvas: they move and zoom the view, or do what the tool does; the cursor that shows it.
import { element } from "./elements.js";

const CLICK = 5; // CSS pixels: a pointer that moves less is a click
const CURSOR_STEP = 8;

export class Pointers {
  constructor(player, screen, tools) {
    Object.assign(this, { player, screen, tools, pointers: new Map(), cursor: null });
    const canvas = element("canvas");
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("mousedown", (event) => { // keys are the page's then, not those of a field, nor of the canvas
      event.preventDefault();
      document.activeElement.blur();
    });
    canvas.addEventListener("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("pointerleave", () => (element("cursor").hidden = true));
    canvas.addEventListener("dblclick", () => this.isSelecting && tools.name === "polygon" && tools.finish());
    canvas.addEventListener("keydown", (event) => this.key(event));
    element("stage").addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  get isSelecting() {
    return this.player.highlighting && this.tools.isSelecting;
  }

  down(event) {
    if (event.button > 1) return;
    element("canvas").setPointerCapture(event.pointerId);
    const [x, y] = this.screen.at(event);
    this.pointers.set(event.pointerId, { x, y });
    this.travelled = this.pointers.size > 1 ? Infinity : 0;
    if (this.pointers.size > 1) this.tools.cancel(); // it is a pinch
    else if (this.isSelecting && event.button === 0) this.tools.down([x, y], event);
  }

  moved(event) {
    this.showCursor(event);
    const own = this.pointers.get(event.pointerId), [x, y] = this.screen.at(event), { view, numPanes } = this.player;
    if (!own) return this.isSelecting && this.tools.hover([x, y]);
    if (this.pointers.size === 2) this.pinch(event.pointerId, x, y);
    else if (this.isSelecting && this.tools.pressed) this.tools.drag([x, y]);
    else {
      view.move(x - own.x, y - own.y, view.paneAt(x, y, numPanes));
      element("stage").classList.add("moving");
      this.player.changed();
    }
    this.travelled += Math.hypot(x - own.x, y - own.y) / this.screen.ratio;
    this.pointers.set(event.pointerId, { x, y });
  }

  /** Two fingers: zoom by their distance, move by their midpoint. */
  pinch(id, x, y) {
    const { view, numPanes } = this.player, moving = this.pointers.get(id);
    const [, still] = [...this.pointers].find(([other]) => other !== id);
    const apart = (point) => Math.max(Math.hypot(point.x - still.x, point.y - still.y), 1);
    const pane = view.paneAt((x + still.x) / 2, (y + still.y) / 2, numPanes);
    view.zoomAt(apart({ x, y }) / apart(moving), (x + still.x) / 2, (y + still.y) / 2, pane);
    view.move((x - moving.x) / 2, (y - moving.y) / 2, pane);
    this.player.changed();
  }

  up(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    element("stage").classList.remove("moving");
    this.tools.up();
    const { player } = this;
    if (event.type === "pointerup" && !player.highlighting && this.travelled < CLICK) player.toggle();
    player.changed();
  }

  /** Where a tool is, by the pointer or by keys. */
  showCursor(event) {
    const { left, top } = element("stage").getBoundingClientRect();
    this.cursor = [event.clientX - left, event.clientY - top];
    this.placeCursor(event.pointerType === "touch" && !this.pointers.size);
  }

  placeCursor(hidden) {
    const cursor = element("cursor"), isBrush = this.tools.name === "brush";
    cursor.hidden = hidden || !this.isSelecting || !this.cursor;
    if (cursor.hidden) return;
    cursor.classList.toggle("cross", !isBrush);
    cursor.style.width = cursor.style.height = `${isBrush ? 2 * this.tools.radius : 22}px`;
    [cursor.style.left, cursor.style.top] = this.cursor.map((own) => `${own}px`);
  }

  /** With the image focused, arrows move the tool and Enter uses it; Shift Enter closes an outline. */
  key(event) {
    if (!this.isSelecting || event.ctrlKey || event.metaKey) return;
    const { ratio, size } = this.screen, way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    this.cursor ??= size.map((own) => own / ratio / 2);
    if (way && !event.altKey) this.cursor = this.cursor.map((own, k) => Math.min(Math.max(own + way[k] * (event.shiftKey ? 1 : CURSOR_STEP), 0), size[k] / ratio));
    else if (event.key === "Enter" && event.shiftKey && this.tools.points.length > 2) this.tools.finish();
    else if (event.key === "Enter") this.tools.tap(this.cursor.map((own) => own * ratio), event);
    else return;
    this.placeCursor(false);
    this.tools.hover(this.cursor.map((own) => own * ratio));
    event.preventDefault();
    event.stopPropagation();
  }

  wheel(event) {
    if (window !== window.top && !event.ctrlKey && !event.metaKey) return; // in a notebook the wheel scrolls
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1, [x, y] = this.screen.at(event);
    this.zoom(Math.exp(-0.0022 * lines * event.deltaY * (event.ctrlKey ? 3 : 1)), x, y);
  }

  zoom(factor, x = this.player.view.area[0] / 2, y = this.player.view.area[1] / 2) {
    const { view, numPanes } = this.player;
    view.zoomAt(factor, x, y, view.paneAt(x, y, numPanes));
    this.player.changed();
  }
}
