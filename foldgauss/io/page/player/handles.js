// Handles on the selection: a frame that moves it, a corner that scales and a knob that rotates it about its center.
import { element } from "./elements.js";

const LEAST = 44; // CSS pixels: the frame's smallest side, so that fingers hit it
const round = (own, digits) => Number(own.toFixed(digits));

export class Handles {
  constructor(player, screen, tools) {
    Object.assign(this, { player, screen, tools });
    for (const name of ["move", "scale", "rotate"]) {
      const handle = element(`handle-${name}`);
      handle.addEventListener("pointerdown", (event) => this.begin(name, event));
      handle.addEventListener("pointermove", (event) => this.drag && this.to(event));
      for (const end of ["pointerup", "pointercancel"]) handle.addEventListener(end, () => this.end());
      handle.addEventListener("keydown", (event) => this.key(name, event));
    }
  }

  begin(name, event) {
    if (event.button > 0 || !this.place) return;
    event.target.setPointerCapture(event.pointerId);
    event.stopPropagation();
    const at = this.pointOf(event), center = this.place.center.map((own) => round(own, 6));
    this.drag = { name, from: at, center, begun: false };
  }

  /** A point in model space. */
  pointOf(event) {
    return this.tools.toModel(this.screen.at(event)).slice(0, 2);
  }

  to(event) {
    const { name, from, center } = this.drag, at = this.pointOf(event), away = (point) => [point[0] - center[0], point[1] - center[1]];
    const [x, y] = away(at), [fromX, fromY] = away(from), size = Math.hypot(fromX, fromY) || 1e-6;
    let step;
    if (name === "move") step = { do: "move", offset: [round(at[0] - from[0], 5), round(at[1] - from[1], 5)] };
    else if (name === "scale") step = { do: "scale", factor: Math.max(round(Math.hypot(x, y) / size, 4), 0.01), about: center };
    else {
      const turn = ((Math.atan2(y, x) - Math.atan2(fromY, fromX)) * 180) / Math.PI, degrees = turn - 360 * Math.round(turn / 360);
      step = { do: "rotate", degrees: event.shiftKey ? 15 * Math.round(degrees / 15) : round(degrees, 2), about: center };
    }
    this.player.editing.edit(step, this.drag.begun);
    this.drag.begun = true;
  }

  end() {
    this.drag = null;
    this.player.onChange();
  }

  /** Arrow keys: a pixel, a percent or a degree; with Shift ten. */
  key(name, event) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!way || !this.place) return;
    event.preventDefault();
    event.stopPropagation();
    const by = event.shiftKey ? 10 : 1, about = this.place.center.map((own) => round(own, 6)), sign = way[0] - way[1];
    if (name === "move") this.nudge(way[0] * by, way[1] * by);
    else if (name === "scale") this.player.editing.edit({ do: "scale", factor: round(1 + 0.01 * by * sign, 4), about });
    else this.player.editing.edit({ do: "rotate", degrees: by * sign, about });
  }

  /** Move the selection by pixels of the video. */
  nudge(x, y) {
    const { base, editing } = this.player, side = Math.max(...base.header.size), { last } = editing.history;
    const [ownX, ownY] = last?.do === "move" ? last.offset : [0, 0]; // one after another are one edit
    editing.edit({ do: "move", offset: [round(ownX + x / side, 6), round(ownY + y / side, 6)] }, true);
  }

  update(count) {
    const { player, screen: { ratio } } = this, shown = player.highlighting && this.tools.name === "transform" && count > 0 && !player.playing;
    this.place = shown || this.drag ? this.tools.picker.placeOf(player.state, player.ownTime) : null;
    const { place } = this;
    element("handles").hidden = !place;
    if (!place) return;
    const { view } = player, pane = view.panes(player.numPanes)[player.shown.findIndex((what) => what !== "original")] ?? view.panes(1)[0];
    const [left, top] = view.toScreen(place.box[0], place.box[1], pane).map((own) => own / ratio);
    const [right, bottom] = view.toScreen(place.box[2], place.box[3], pane).map((own) => own / ratio);
    const wide = Math.max(right - left, LEAST), high = Math.max(bottom - top, LEAST), style = element("handles").style;
    style.left = `${(left + right - wide) / 2}px`;
    style.top = `${(top + bottom - high) / 2}px`;
    [style.width, style.height] = [`${wide}px`, `${high}px`];
  }
}
