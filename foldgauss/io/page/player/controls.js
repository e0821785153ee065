// The controls of a player: they change it, and show its state whenever that has changed.
import { element, toast } from "./elements.js";
import { Following } from "./following.js";
import { Handles } from "./handles.js";
import { bindKeys } from "./keys.js";
import { Panel } from "./panel.js";
import { Panes } from "./panes.js";
import { Pointers } from "./pointers.js";
import { Recording } from "./recording.js";
import { Screen } from "./screen.js";
import { Tools } from "./tools.js";
import { Transport } from "./transport.js";

export class Controls {
  /** For a player that shows a model. */
  constructor(player, files) {
    this.player = player;
    this.screen = new Screen();
    this.transport = new Transport(player);
    this.panes = new Panes(player, this.screen);
    this.tools = new Tools(player, this.screen);
    this.pointers = new Pointers(player, this.screen, this.tools);
    this.handles = new Handles(player, this.screen, this.tools);
    this.panel = new Panel(player, this.tools, new Following(player, this.tools));
    this.recording = new Recording(player, files);
    bindKeys({ ...this, files });
    new ResizeObserver(() => player.resize(...this.screen.size)).observe(element("stage"));
  }

  /** Describe a model that was opened. */
  describe() {
    for (const part of [this.transport, this.panes, this.recording]) part.describe();
    this.player.resize(...this.screen.size);
  }

  /** Show the player's state. */
  update() {
    const { player } = this;
    this.transport.update();
    this.panes.update();
    this.panel.update();
    this.handles.update(player.highlighting ? player.editing.count(player.lead.number, player.base) : 0);
    this.updateOutline();
    this.updateMissing(player.segments.missing);
  }

  updateOutline() {
    const points = this.player.highlighting && this.tools.drawsOutline ? this.tools.outline : [], { ratio } = this.screen;
    element("outline").toggleAttribute("hidden", points.length < 2);
    const path = points.map((point) => point.map((own) => (own / ratio).toFixed(1)).join(" ")).join("L");
    for (const one of element("outline").children) one.setAttribute("d", path && `M${path}Z`);
  }

  /** Show a message while a segment is being decoded. */
  updateMissing(missing) {
    if (missing === this.missing) return;
    if (this.missing !== undefined) element("toast").hidden = true;
    this.missing = missing;
    clearTimeout(this.soon);
    if (missing !== undefined) this.soon = setTimeout(() => toast(`Decoding segment ${missing + 1}`, 60_000), 200);
  }
}
