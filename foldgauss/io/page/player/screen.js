// The stage on the screen: its size in device pixels, and where events are on it.
import { element } from "./elements.js";

export class Screen {
  get ratio() {
    return Math.min(window.devicePixelRatio || 1, 3);
  }

  get size() {
    const { clientWidth, clientHeight } = element("stage");
    return [clientWidth, clientHeight].map((own) => Math.max(Math.round(own * this.ratio), 1));
  }

  /** Position of an event, in device pixels of the canvas. */
  at(event) {
    const { left, top } = element("stage").getBoundingClientRect();
    return [(event.clientX - left) * this.ratio, (event.clientY - top) * this.ratio];
  }
}
