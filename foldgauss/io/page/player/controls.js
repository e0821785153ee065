// Buttons, keys and pointers, and the texts and controls that show the state of the player.
import { element } from "./elements.js";
import { SPEEDS } from "./player.js";

const CLICK = 5; // CSS pixels: a pointer that moves less is a click
const CAPTIONS = { model: "Model", original: "Original", difference: "Difference × 4" };

/** Seconds as minutes, seconds and hundredths. */
function clock(seconds) {
  const hundredths = Math.floor(seconds * 100 + 1e-6), rest = hundredths % 6000;
  return `${Math.floor(hundredths / 6000)}:${String(Math.floor(rest / 100)).padStart(2, "0")}.${String(rest % 100).padStart(2, "0")}`;
}

const speedName = (speed) => (speed < 1 ? `1/${Math.round(1 / speed)}×` : `${speed}×`);
const press = (name, on) => element(name).setAttribute("aria-pressed", String(Boolean(on)));
const put = (name, text) => {
  if (element(name).textContent !== text) element(name).textContent = text;
};

/** A slider with the part before its thumb filled. */
function fill(slider, value) {
  slider.value = value;
  slider.style.setProperty("--done", `${(100 * (slider.value - slider.min)) / (slider.max - slider.min || 1)}%`);
}

function recall(name) {
  try {
    return localStorage.getItem(name);
  } catch {
    return null; // storage is not allowed in some frames
  }
}

function remember(name, value) {
  try {
    localStorage.setItem(name, value);
  } catch {
    // storage is not allowed in some frames
  }
}

export class Controls {
  constructor(player) {
    this.player = player;
    this.pointers = new Map();
    this.erasing = false;
    this.bindTheme();
    this.bindTransport();
    this.bindModes();
    this.bindPanel();
    this.bindPointers();
    this.bindKeys();
    const watcher = new ResizeObserver(() => this.resize());
    watcher.observe(element("stage"));
    this.resize();
    this.describe();
  }

  get ratio() {
    return Math.min(window.devicePixelRatio || 1, 3);
  }

  resize() {
    const { clientWidth, clientHeight } = element("stage");
    this.player.resize(Math.max(Math.round(clientWidth * this.ratio), 1), Math.max(Math.round(clientHeight * this.ratio), 1));
  }

  describe() {
    const { model, timeline, segments } = this.player, [height, width] = model.header.size, bytes = segments.decoder.numBytes;
    const size = bytes < 1e6 ? `${Math.round(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
    const parts = segments.spans.length > 1 ? ` in ${segments.spans.length} segments` : "";
    put("facts", `${width} × ${height} · ${timeline.last + 1} frames${parts} · ${size}`);
    element("scrub").max = timeline.last;
    for (const one of document.querySelectorAll(".with-original")) one.hidden = !this.player.hasOriginal;
    element("modes").hidden = !this.player.hasOriginal;
  }

  // --------------------------------------------------------------------------------------------------- display

  /** Update all texts and controls. */
  update() {
    const { player } = this, { timeline, position, playing, edit, selection } = player, { last, fps } = timeline;
    put("now", clock(position / fps));
    put("whole", `/ ${clock(last / fps)}`);
    put("frame", `frame ${playing || Number.isInteger(position) ? Math.round(position) : position.toFixed(2)} of ${last}`);
    fill(element("scrub"), position);
    element("scrub").setAttribute("aria-valuetext", `frame ${position.toFixed(1)} of ${last}`);
    element("toggle-icon").setAttribute("href", playing ? "#i-pause" : "#i-play");
    element("toggle").setAttribute("aria-label", playing ? "Pause" : "Play");
    press("loop", player.loop);
    press("brush", player.brushing);
    element("speed").value = String(player.speed);
    const number = (value) => value.toLocaleString("en");
    const rate = playing && player.rate > 2 ? ` · ${player.rate} fps` : "";
    if (!playing || this.shownAt !== Math.floor(performance.now() / 250))
      put("stats", `${number(player.alive)} of ${number(player.segments.total)} Gaussians${rate}`);
    this.shownAt = Math.floor(performance.now() / 250);
    put("zoom", player.view.isReset ? "" : `${player.view.zoom.toFixed(1)}×`);
    element("stage").classList.toggle("zoomed", !player.view.isReset);
    element("stage").classList.toggle("brushing", player.brushing);
    for (const button of element("modes").children)
      button.setAttribute("aria-pressed", String(button.dataset.mode === player.mode));
    this.updatePanel(edit, selection.count, number);
    this.updateMissing(player.segments.missing);
    this.updateOverlays();
  }

  updatePanel(edit, count, number) {
    element("panel").hidden = !this.player.brushing;
    const { segments, lead } = this.player, { length } = segments.spans;
    put("picked", count ? `${number(count)} ${length > 1 ? "in this segment" : "selected"}` : "Paint over something");
    if (!this.following) put("follow", `Follow through ${length > 1 ? `segment ${lead.number + 1} of ${length}` : "the clip"}`);
    press("pick", !this.erasing);
    press("erase", this.erasing);
    press("vanish", edit.vanish);
    press("front", this.player.inFront);
    element("undo").disabled = this.following || this.player.selection.strokes.length === 0;
    for (const name of ["clear", "follow", "vanish", "front", "scale", "copies", "offset", "copy"]) element(name).disabled = !count;
    if (this.following) for (const name of ["clear", "follow"]) element(name).disabled = true;
    element("offset").disabled ||= edit.copies === 1;
    for (const name of ["scale", "copies", "offset"]) fill(element(name), edit[name]);
    fill(element("radius"), element("radius").value);
    put("radius-value", `${element("radius").value} px`);
    put("scale-value", `${edit.scale.toFixed(2)}×`);
    put("copies-value", String(edit.copies));
    put("offset-value", edit.offset.toFixed(2));
  }

  /** Show a message while a segment is being decoded. */
  updateMissing(missing) {
    if (missing === this.missing) return;
    if (this.missing !== undefined) element("toast").hidden = true;
    this.missing = missing;
    clearTimeout(this.soon);
    if (missing !== undefined) this.soon = setTimeout(() => this.toast(`Decoding segment ${missing + 1}`, 60_000), 200);
  }

  /** Place the captions and the divider over the images. */
  updateOverlays() {
    const { player, ratio } = this, panes = player.view.panes(player.numPanes);
    const captions = player.mode === "slider" ? ["original", "model"] : player.mode === "model" ? [] : player.shown;
    [0, 1].forEach((k) => {
      const caption = element(`caption-${k}`), frame = player.view.frameIn(panes[Math.min(k, panes.length - 1)]);
      caption.hidden = k >= captions.length;
      if (caption.hidden) return;
      put(caption.id, CAPTIONS[captions[k]]);
      const pane = panes[Math.min(k, panes.length - 1)], right = player.mode === "slider" && k === 1;
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

  toast(text, milliseconds = 2600) {
    put("toast", text);
    element("toast").hidden = false;
    clearTimeout(this.hiding);
    this.hiding = setTimeout(() => (element("toast").hidden = true), milliseconds);
  }

  // --------------------------------------------------------------------------------------------------- buttons

  on(name, event, does) {
    element(name).addEventListener(event, does);
  }

  bindTheme() {
    const wished = matchMedia("(prefers-color-scheme: light)");
    const show = (theme) => (document.documentElement.dataset.theme = theme);
    show(recall("foldgauss-theme") ?? (wished.matches ? "light" : "dark"));
    wished.addEventListener("change", () => recall("foldgauss-theme") ?? show(wished.matches ? "light" : "dark"));
    this.theme = () => {
      show(document.documentElement.dataset.theme === "light" ? "dark" : "light");
      remember("foldgauss-theme", document.documentElement.dataset.theme);
    };
    this.full = () => {
      if (document.fullscreenElement) document.exitFullscreen();
      else document.documentElement.requestFullscreen?.().catch(() => this.toast("Full screen is not allowed here."));
    };
    element("full").hidden = !document.fullscreenEnabled;
    this.on("theme", "click", this.theme);
    this.on("full", "click", this.full);
    this.help = () => {
      element("help").showModal();
      element("help-title").focus(); // not the button, whose focus ring would distract
    };
    this.on("help-open", "click", this.help);
    this.on("help-close", "click", () => element("help").close());
    this.on("help", "click", (event) => event.target === element("help") && element("help").close());
  }

  bindTransport() {
    const { player } = this;
    for (const speed of SPEEDS) element("speed").append(new Option(speedName(speed), String(speed)));
    this.on("toggle", "click", () => player.toggle());
    this.on("back", "click", () => player.step(-1));
    this.on("next", "click", () => player.step(1));
    this.on("loop", "click", () => this.toggleLoop());
    this.on("speed", "change", () => this.setSpeed(Number(element("speed").value)));
    this.on("scrub", "input", () => player.seekPosition(Number(element("scrub").value)));
    this.on("fit", "click", () => this.reset());
    this.on("brush", "click", () => this.toggleBrush());
  }

  toggleLoop() {
    this.player.loop = !this.player.loop;
    this.player.onChange();
  }

  setSpeed(speed) {
    this.player.speed = speed;
    this.player.onChange();
  }

  reset() {
    this.player.view.reset();
    this.player.changed();
  }

  toggleBrush(on = !this.player.brushing) {
    this.player.brushing = on;
    element("cursor").hidden = true;
    this.player.changed();
  }

  bindModes() {
    for (const button of element("modes").children) button.addEventListener("click", () => this.setMode(button.dataset.mode));
    const divider = element("divider");
    const move = (event) => {
      const frame = this.player.view.frameIn(this.player.view.panes(1)[0]), left = element("stage").getBoundingClientRect().left;
      this.setSplit(((event.clientX - left) * this.ratio - frame.x) / frame.width);
    };
    divider.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      divider.setPointerCapture(event.pointerId);
      divider.onpointermove = move;
    });
    divider.addEventListener("pointerup", () => (divider.onpointermove = null));
    divider.addEventListener("pointercancel", () => (divider.onpointermove = null));
    divider.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (by === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      this.setSplit(this.player.split + by);
    });
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

  // ------------------------------------------------------------------------------------------------- the brush

  bindPanel() {
    const { player } = this, change = (name, to) => {
      player.edit[name] = to;
      player.changed();
    };
    const erase = (on) => {
      this.erasing = on;
      player.onChange();
    };
    this.on("panel-close", "click", () => this.toggleBrush(false));
    this.on("pick", "click", () => erase(false));
    this.on("erase", "click", () => erase(true));
    this.on("undo", "click", () => this.undo());
    this.on("clear", "click", () => this.following || player.resetEdit());
    this.on("radius", "input", () => player.onChange());
    this.on("follow", "click", () => this.follow());
    this.on("vanish", "click", () => change("vanish", !player.edit.vanish));
    this.on("front", "click", () => change("front", !player.inFront));
    for (const name of ["scale", "copies", "offset"]) this.on(name, "input", () => change(name, Number(element(name).value)));
    this.on("copy", "click", () => this.copy());
  }

  undo() {
    if (this.following) return;
    this.player.selection.undo();
    this.player.changed();
  }

  async follow() {
    if (this.following) return;
    const { player } = this;
    let more = 0;
    this.following = true;
    player.onChange();
    try {
      more = await player.follow(async (fraction) => {
        put("follow", `Following ${Math.round(100 * fraction)} %`);
        await new Promise((next) => setTimeout(next));
      });
    } finally {
      this.following = false;
    }
    this.toast(`${more.toLocaleString("en")} more Gaussians selected`);
    player.changed();
  }

  /** Copy the indices of the selected Gaussians, for Python. */
  async copy() {
    const { selection, model, segments, lead } = this.player, which = segments.spans.length > 1 ? { segment: lead.number } : {};
    const text = JSON.stringify({ ...which, num_gaussians: model.num, indices: selection.indices() });
    try {
      await navigator.clipboard.writeText(text);
      this.toast("Copied. See docs/player.md for how to use it in Python.");
    } catch {
      this.toast("The browser does not allow copying here.");
    }
  }

  // -------------------------------------------------------------------------------------------------- pointers

  /** Position of an event, in device pixels of the canvas. */
  at(event) {
    const { left, top } = element("stage").getBoundingClientRect();
    return [(event.clientX - left) * this.ratio, (event.clientY - top) * this.ratio];
  }

  bindPointers() {
    const canvas = element("canvas");
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.up(event));
    canvas.addEventListener("pointerleave", () => (element("cursor").hidden = true));
    element("stage").addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  get radius() {
    return Number(element("radius").value);
  }

  paint(event) {
    const [x, y] = this.at(event);
    this.player.paint(x, y, this.radius * this.ratio, this.erasing !== event.altKey);
  }

  down(event) {
    if (event.button > 0) return;
    element("canvas").setPointerCapture(event.pointerId);
    const [x, y] = this.at(event);
    this.pointers.set(event.pointerId, { x, y });
    this.travelled = this.pointers.size > 1 ? Infinity : 0;
    if (this.player.brushing && this.pointers.size === 1) {
      this.player.beginStroke();
      this.paint(event);
    }
  }

  moved(event) {
    this.showCursor(event);
    const own = this.pointers.get(event.pointerId);
    if (!own) return;
    const [x, y] = this.at(event), { view } = this.player;
    if (this.pointers.size === 2) this.pinch(event.pointerId, x, y);
    else if (this.player.brushing) this.paint(event);
    else {
      view.move(x - own.x, y - own.y, view.paneAt(x, y, this.player.numPanes));
      element("stage").classList.add("moving");
      this.player.invalidate();
    }
    this.travelled += Math.hypot(x - own.x, y - own.y) / this.ratio;
    this.pointers.set(event.pointerId, { x, y });
  }

  /** Two fingers: zoom by their distance, move by their midpoint. */
  pinch(id, x, y) {
    const { view } = this.player, moving = this.pointers.get(id);
    const [, still] = [...this.pointers].find(([other]) => other !== id);
    const apart = (point) => Math.max(Math.hypot(point.x - still.x, point.y - still.y), 1);
    const pane = view.paneAt((x + still.x) / 2, (y + still.y) / 2, this.player.numPanes);
    view.zoomAt(apart({ x, y }) / apart(moving), (x + still.x) / 2, (y + still.y) / 2, pane);
    view.move((x - moving.x) / 2, (y - moving.y) / 2, pane);
    this.player.changed();
  }

  up(event) {
    if (!this.pointers.delete(event.pointerId)) return;
    element("stage").classList.remove("moving");
    const { player } = this;
    player.endStroke();
    if (event.type === "pointerup" && !player.brushing && this.travelled < CLICK) player.toggle();
    player.changed();
  }

  showCursor(event) {
    const cursor = element("cursor"), { left, top } = element("stage").getBoundingClientRect();
    cursor.hidden = !this.player.brushing;
    cursor.style.width = cursor.style.height = `${2 * this.radius}px`;
    cursor.style.left = `${event.clientX - left}px`;
    cursor.style.top = `${event.clientY - top}px`;
  }

  wheel(event) {
    if (window !== window.top && !event.ctrlKey && !event.metaKey) return; // in a notebook the wheel scrolls
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1, [x, y] = this.at(event);
    this.zoom(Math.exp(-0.0022 * lines * event.deltaY * (event.ctrlKey ? 3 : 1)), x, y);
  }

  zoom(factor, x = this.player.view.area[0] / 2, y = this.player.view.area[1] / 2) {
    const { view } = this.player;
    view.zoomAt(factor, x, y, view.paneAt(x, y, this.player.numPanes));
    this.player.changed();
  }

  // ------------------------------------------------------------------------------------------------------ keys

  bindKeys() {
    const { player } = this, { timeline } = player, faster = (by) => {
      const k = SPEEDS.indexOf(player.speed) + by;
      if (SPEEDS[k]) this.setSpeed(SPEEDS[k]);
    };
    const skip = (way, event) => player.seekPosition(player.position + way * (event.shiftKey ? 0.1 : timeline.fps / 2));
    this.keys = {
      " ": () => player.toggle(), k: () => player.toggle(),
      ArrowLeft: (event) => skip(-1, event), ArrowRight: (event) => skip(1, event),
      ",": () => player.step(-1), ".": () => player.step(1),
      Home: () => player.seekPosition(0), End: () => player.seekPosition(timeline.last),
      "[": () => faster(-1), "]": () => faster(1), "<": () => faster(-1), ">": () => faster(1),
      l: () => this.toggleLoop(), "0": () => this.reset(), "+": () => this.zoom(1.25), "=": () => this.zoom(1.25),
      "-": () => this.zoom(0.8), b: () => this.toggleBrush(), z: () => this.undo(), f: () => this.full(), t: () => this.theme(),
      "?": () => this.help(), Escape: () => this.toggleBrush(false),
    };
    ["model", "original", "slider", "side", "difference"].forEach((mode, k) => (this.keys[k + 1] = () => this.setMode(mode)));
    document.addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    if (event.ctrlKey && event.key === "z") event.preventDefault();
    else if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (element("help").open) return;
    const { target } = event, does = this.keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const slider = target.matches?.("input[type=range]:not(#scrub), select") && /^(Arrow|Home|End)/.test(event.key);
    if (!does || slider || (target.matches?.("button, select") && event.key === " ")) return;
    event.preventDefault();
    does(event);
  }
}
