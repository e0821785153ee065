// The button that selects the same object in all other frames, with its progress; it can be stopped.
import { element, on, put, toast } from "./elements.js";
import { follow } from "./tracking.js";

export class Following {
  constructor(player, tools) {
    Object.assign(this, { player, tools, running: false });
    on("follow", "click", () => (this.running ? (this.stopped = true) : this.run()));
  }

  async run() {
    const { player, tools } = this, { lead, state, editing } = player;
    [this.running, this.stopped] = [true, false];
    player.onChange();
    let found = null;
    try {
      found = await follow(tools.picker, state, lead.time, lead.timeline.times, async (fraction) => {
        put("follow", `Following ${Math.round(100 * fraction)} % — stop`);
        await new Promise((next) => setTimeout(next));
        return !this.stopped && player.editing === editing;
      });
    } finally {
      this.running = false;
    }
    if (!found || player.editing !== editing) return player.onChange();
    const before = editing.count(lead.number, lead.base);
    if (found.length === editing.stateOf(lead.number, lead.base).selected.length) editing.select(lead.number, lead.base, found, "add");
    const more = editing.count(lead.number, lead.base) - before;
    toast(`${more.toLocaleString("en")} more Gaussians selected`);
  }

  update(count) {
    const { segments, lead } = this.player, { length } = segments.spans;
    if (!this.running) put("follow", `Follow through ${length > 1 ? `segment ${lead.number + 1} of ${length}` : "the clip"}`);
    element("follow").disabled = !count && !this.running;
  }
}
