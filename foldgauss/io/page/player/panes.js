// The original beside the model: display modes, the divider between them, captions, and the zoom that is shown.
import { element, on, pressOne, put } from "./elements.js";

const CAPTIONS = { model: "Model", original: "Original", difference: "Difference × 4" };
export const MODES = ["model", "original", "slider", "side", "difference"];

export class Panes {
  constructor(player, screen) {
    [this.player, this.screen] = [player, screen];
    on("fit", "click", () => this.reset());
    for (const button of element("modes").children) button.addEventListener("click", () => this.setMode(button.dataset.mode));
    const divider = element("divider");
    divider.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      divider.setPointerCapture(event.pointerId);
      divider.onpointermove = (moved) => this.dragTo(moved);
    });
    for (const end of ["pointerup", "pointercancel"]) divider.addEventListener(end, () => (divider.onpointermove = null));
    divider.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (by === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      this.setSplit(player.split + by);
    });
  }

  /** Show what there is for a model that was opened. */
  describe() {
    for (const one of document.querySelectorAll(".with-original")) one.hidden = !this.player.hasOriginal;
    element("modes").hidden = !this.player.hasOriginal;
  }

  dragTo(event) {
    const { view } = this.player, frame = view.frameIn(view.panes(1)[0]);
    this.setSplit((this.screen.at(event)[0] - frame.x) / frame.width);
  }

  setMode(mode) {
    if (!this.player.hasOriginal && mode !== "model") return;
    this.player.mode = mode;
    this.player.changed();
  }

  setSplit(split) {
    this.player.split = Math.min(Math.max(split, 0), 1);
    this.player.changed();
  }

  reset() {
    this.player.view.reset();
    this.player.changed();
  }

  update() {
    const { player } = this;
    put("zoom", player.view.isReset ? "" : `${player.view.zoom.toFixed(1)}×`);
    element("stage").classList.toggle("zoomed", !player.view.isReset);
    pressOne("modes", "mode", player.mode);
    this.updateOverlays();
  }

  /** Place the captions and the divider over the images. */
  updateOverlays() {
    const { player, screen: { ratio } } = this, panes = player.view.panes(player.numPanes);
    const captions = player.mode === "slider" ? ["original", "model"] : player.mode === "model" ? [] : player.shown;
    [0, 1].forEach((k) => {
      const caption = element(`caption-${k}`), pane = panes[Math.min(k, panes.length - 1)], frame = player.view.frameIn(pane);
      caption.hidden = k >= captions.length;
      if (caption.hidden) return;
      put(caption.id, CAPTIONS[captions[k]]);
      const right = player.mode === "slider" && k === 1;
      const x = right ? Math.min(frame.x + frame.width, pane.x + pane.width) : Math.max(frame.x, pane.x);
      const away = right ? `${x / ratio - 10}px` : `${x / ratio + 10}px`;
      caption.style.transform = `translate(${away}, ${Math.max(frame.y, pane.y) / ratio + 10}px)${right ? " translateX(-100%)" : ""}`;
    });
    const divider = element("divider"), frame = player.view.frameIn(panes[0]);
    divider.hidden = player.mode !== "slider";
    const top = Math.max(frame.y, 0), bottom = Math.min(frame.y + frame.height, player.view.area[1]);
    divider.style.transform = `translate(${(frame.x + player.split * frame.width) / ratio}px, ${top / ratio}px)`;
    divider.style.height = `${(bottom - top) / ratio}px`;
    divider.setAttribute("aria-valuenow", String(Math.round(100 * player.split)));
  }
}
