// Play, position, speed and loop: their buttons, and the texts that show them.
import { element, fill, on, press, put } from "./elements.js";
import { SPEEDS } from "./player.js";

/** Seconds as minutes, seconds and hundredths. */
function clock(seconds) {
  const hundredths = Math.floor(seconds * 100 + 1e-6), rest = hundredths % 6000;
  return `${Math.floor(hundredths / 6000)}:${String(Math.floor(rest / 100)).padStart(2, "0")}.${String(rest % 100).padStart(2, "0")}`;
}

const speedName = (speed) => (speed < 1 ? `1/${Math.round(1 / speed)}×` : `${speed}×`);

export class Transport {
  constructor(player) {
    this.player = player;
    for (const speed of SPEEDS) element("speed").append(new Option(speedName(speed), String(speed)));
    on("toggle", "click", () => player.toggle());
    on("back", "click", () => player.step(-1));
    on("next", "click", () => player.step(1));
    on("loop", "click", () => this.toggleLoop());
    on("speed", "change", () => this.setSpeed(Number(element("speed").value)));
    on("scrub", "input", () => player.seekPosition(Number(element("scrub").value)));
  }

  /** Describe a model that was opened. */
  describe() {
    const { base, timeline, segments } = this.player, [height, width] = base.header.size, bytes = segments.decoder.numBytes;
    const size = bytes < 1e6 ? `${Math.round(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
    const parts = segments.spans.length > 1 ? ` in ${segments.spans.length} segments` : "";
    put("facts", `${width} × ${height} · ${timeline.last ? `${timeline.last + 1} frames` : "still image"}${parts} · ${size}`);
    element("scrub").max = timeline.last;
  }

  toggleLoop() {
    this.player.loop = !this.player.loop;
    this.player.onChange();
  }

  setSpeed(speed) {
    this.player.speed = speed;
    this.player.onChange();
  }

  /** The next speed of the list, faster or slower. */
  changeSpeed(by) {
    const next = SPEEDS[SPEEDS.indexOf(this.player.speed) + by];
    if (next) this.setSpeed(next);
  }

  /** Half a second on or back; `finely`: a tenth of a frame. */
  skip(way, finely) {
    const { player } = this, { timeline, position } = player;
    player.seekPosition(finely ? position + 0.1 * way : timeline.positionAt(timeline.secondOf(position) + 0.5 * way));
  }

  update() {
    const { player } = this, { timeline, timeline: { last }, position, playing } = player;
    put("now", clock(timeline.secondOf(position)));
    put("whole", `/ ${clock(timeline.secondOf(last))}`);
    put("frame", `frame ${playing || Number.isInteger(position) ? Math.round(position) : position.toFixed(2)} of ${last}`);
    fill(element("scrub"), position);
    element("scrub").setAttribute("aria-valuetext", `frame ${position.toFixed(1)} of ${last}`);
    element("toggle-icon").setAttribute("href", playing ? "#i-pause" : "#i-play");
    element("toggle").setAttribute("aria-label", playing ? "Pause" : "Play");
    press("loop", player.loop);
    element("speed").value = String(player.speed);
    this.updateStats();
  }

  updateStats() {
    const { player } = this, quarter = Math.floor(performance.now() / 250), number = (value) => value.toLocaleString("en");
    const rate = player.playing && player.rate > 2 ? ` · ${player.rate} fps` : "";
    const { decoder } = player.segments, loading = decoder.isWhole ? "" : `Loading ${Math.floor(100 * decoder.arrived.fraction)}% · `;
    if (!player.playing || this.shownAt !== quarter) put("stats", `${loading}${number(player.alive)} of ${number(player.segments.total)} Gaussians${rate}`);
    this.shownAt = quarter;
  }
}
