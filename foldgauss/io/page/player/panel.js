// The editor's panel: tools, and edits of the selection by buttons, sliders and numbers.
import { element, fill, on, press, pressOne, put, toast } from "./elements.js";
import { isAlike } from "./editing.js";
import { UNFINISHED } from "./loading.js";
import { filled, totalOf, totalOfStep } from "./totals.js";

const BUTTONS = {
  "select-all": "selectAll", "select-none": "selectNone", invert: "invert", grow: "grow", shrink: "shrink",
};
const round = (own, digits = 6) => Number(own.toFixed(digits));
const value = (name) => Number(element(name).value);

/**
 * Inputs of an edit. `show(total, facts)`: their values, of what the edits of the selection add up to. `step(values, facts,
 * total)`: the edit that makes these of a total; `total` is known in all its numbers then. `empty`: while nothing is known.
 * The inputs of copies show and name the step itself.
 */
const FORMS = {
  move: {
    inputs: ["move-x", "move-y"], empty: [0, 0],
    show: ({ right, down }, { side }) => [round(right * side, 2), round(down * side, 2)],
    step: ([x, y], { side }, { right, down }) => ({ do: "move", offset: [round(x / side - right), round(y / side - down)] }),
  },
  scale: {
    inputs: ["scale"], empty: [100], show: ({ scale }) => [round(100 * scale, 2)],
    step: ([percent], { center, last }, { scale }) => percent > 0 && { do: "scale", factor: round(percent / 100 / scale), about: last?.about ?? center },
  },
  rotate: {
    inputs: ["rotate"], empty: [0], show: ({ degrees }) => [round(degrees, 3)],
    step: ([degrees], { center, last }, total) => ({ do: "rotate", degrees: round(degrees - total.degrees), about: last?.about ?? center }),
  },
  hue: {
    inputs: ["hue"], empty: [0], slides: true, show: ({ hue }) => [Math.round(360 * hue)],
    step: ([degrees]) => degrees >= 0 && degrees <= 360 && { do: "recolor", hue: round(degrees / 360) },
  },
  gain: {
    inputs: ["gain"], empty: [1], slides: true, show: ({ gain }) => [round(gain, 4)],
    step: ([gain], _, total) => gain >= 0 && { do: "recolor", gain: round(gain / (total.gain || 1)) }, // what is black stays so
  },
  opacity: {
    inputs: ["opacity"], empty: [1], slides: true, show: ({ opacity }) => [round(opacity, 4)],
    step: ([opacity], _, total) => opacity > 0 && { do: "opacity", factor: round(opacity / total.opacity) },
  },
  shift: {
    inputs: ["shift"], empty: [0], timed: true, show: ({ shift }, { frames }) => [round(shift * frames, 3)],
    step: ([later], { frames }, { shift }) => ({ do: "retime", shift: round(later / frames - shift) }),
  },
  stretch: {
    inputs: ["stretch"], empty: [1], timed: true, show: ({ speed }) => [round(speed, 3)],
    step: ([speed], { time, last }, total) => Math.abs(speed) >= 0.01 && { do: "retime", stretch: round(total.speed / speed), about: last?.about ?? round(time) },
  },
  multiply: {
    inputs: ["copies", "delay", "apart-x", "apart-y"], empty: null,
    show: ({ offsets, delays = [0] }, { side, frames }) => [offsets.length, round([delays].flat()[0] * frames, 3), ...offsets[0].map((own) => round(own * side, 2))],
    step: ([copies, delay, x, y], { side, frames }) => {
      const each = Array.from({ length: Math.min(Math.max(Math.round(copies), 1), 100) }, (_, k) => k + 1);
      return { do: "multiply", offsets: each.map((k) => [round((k * x) / side), round((k * y) / side)]), delays: each.map((k) => round((k * delay) / frames)) };
    },
  },
};

export class Panel {
  constructor(player, tools, following) {
    Object.assign(this, { player, tools, following });
    on("edit", "click", () => this.toggle());
    on("panel-close", "click", () => this.toggle(false));
    on("undo", "click", () => this.undo());
    on("redo", "click", () => this.redo());
    for (const button of element("tools").children) button.addEventListener("click", () => tools.choose(button.dataset.tool));
    for (const button of element("how").children) button.addEventListener("click", () => this.chooseHow(button.dataset.how));
    for (const [name, method] of Object.entries(BUTTONS)) on(name, "click", () => tools[method]());
    for (const [name, form] of Object.entries(FORMS))
      for (const input of form.inputs) for (const own of form.slides ? [input, `${input}-value`] : [input]) on(own, "input", () => this.changed(name, own));
    on("duplicate", "click", () => this.duplicate());
    on("freeze", "click", () => this.act({ do: "freeze", at: round(player.position, 3) }));
    on("to-front", "click", () => this.act({ do: "to_front" }));
    on("to-back", "click", () => this.act({ do: "to_back" }));
    on("vanish", "click", () => this.remove());
  }

  toggle(open = !this.player.highlighting) {
    if (open && !this.player.segments.decoder.isWhole) return toast(UNFINISHED, 8000);
    this.tools.cancel();
    this.player.highlighting = open;
    element("cursor").hidden = true;
    this.player.changed();
  }

  chooseHow(how) {
    this.tools.how = how;
    this.player.onChange();
  }

  undo() {
    this.tools.cancel();
    this.player.editing.history.undo();
  }

  redo() {
    this.tools.cancel();
    this.player.editing.history.redo();
  }

  get hasSelection() {
    const { editing, lead } = this.player, { selection } = editing;
    return editing.count(lead.number, lead.base) > 0 || Object.keys(selection).some((number) => Number(number) !== lead.number);
  }

  act(step, amends = false) {
    try {
      if (this.hasSelection) this.player.editing.edit(step, amends);
    } catch (error) {
      toast(error.message, 8000);
    }
  }

  remove() {
    this.act({ do: "vanish" });
  }

  duplicate() {
    this.act(FORMS.multiply.step(FORMS.multiply.inputs.map(value), this.facts()));
  }

  /** What the forms need to know of the model. */
  facts() {
    const { player } = this, { base } = player, { last } = player.editing.history;
    const center = this.tools.picker.placeOf(player.state, player.ownTime)?.center ?? [0, 0];
    return { side: Math.max(...base.header.size), frames: Math.max(player.timeline.last, 1), time: player.time, center: center.map((own) => round(own)), last };
  }

  /** An input of a form was changed: change the last edit if it is of that kind, else add one. */
  changed(name, input) {
    const form = FORMS[name], values = form.inputs.map((own) => value(own === input || !form.slides ? own : input));
    if (!values.every(Number.isFinite) || element(input).value === "") return;
    const facts = this.facts(), like = form.step(values, { ...facts, last: null }, filled({}));
    if (!like) return;
    const amends = isAlike(facts.last, like);
    if (amends || name !== "multiply") this.act(form.step(values, amends ? facts : { ...facts, last: null }, this.totalBefore(amends)), amends);
  }

  /** What the edits of the selection add up to, without the last one on demand. */
  totalBefore(last) {
    const { editing, lead } = this.player, { current } = editing.history;
    return filled(totalOf(editing.stateOf(lead.number, lead.base, last ? current.slice(0, -1) : current)));
  }

  update() {
    const { player, tools } = this, { lead, editing, segments } = player;
    element("panel").hidden = !player.highlighting;
    press("edit", player.highlighting);
    element("stage").classList.toggle("selecting", player.highlighting && tools.isSelecting);
    if (!player.highlighting) return;
    const count = editing.count(lead.number, lead.base);
    this.following.update(count);
    put("picked", this.describe(count, editing.fileCount(lead.number, lead.base)));
    pressOne("tools", "tool", tools.name);
    pressOne("how", "how", tools.how);
    element("undo").disabled = !editing.history.canUndo;
    element("redo").disabled = !editing.history.canRedo;
    const { hasSelection } = this;
    for (const name of ["select-none", "grow", "shrink"]) element(name).disabled = !count;
    element("edits").disabled = !hasSelection;
    for (const name of ["shift", "stretch", "freeze", "delay"]) element(name).disabled = segments.spans.length > 1 || player.timeline.last === 0; // a still image has no time
    for (const name of ["radius", "tolerance"]) this.showSlide(name, tools[name]);
    element("radius").parentElement.hidden = tools.name !== "brush";
    element("tolerance").parentElement.hidden = tools.name !== "eyedropper";
    element("how").hidden = !tools.isSelecting;
    this.showForms();
  }

  /** How many are selected, and of how many of the file's they are copies. */
  describe(count, inFile) {
    const [all, own] = [count, inFile].map((number) => number.toLocaleString("en"));
    if (!count) return "Nothing selected";
    if (count > inFile) return `${all}, copies of ${own}`;
    return `${all} ${this.player.segments.spans.length > 1 ? "in this segment" : "selected"}`;
  }

  showSlide(name, own) {
    fill(element(name), own);
    this.showNumber(`${name}-value`, own);
  }

  /** Show a number, unless it is the one being typed; none for NaN. */
  showNumber(name, own) {
    const input = element(name), isTyped = document.activeElement === input && (input.value === "" || Number(input.value) === own);
    if (!isTyped) input.value = Number.isFinite(own) ? own : "";
  }

  /** Show what the edits of the selection add up to; where its Gaussians differ the last edit, if it is of that kind. */
  showForms() {
    const { state, base, timeline, editing } = this.player, { last } = editing.history, total = totalOf(state);
    const facts = { side: Math.max(...base.header.size), frames: Math.max(timeline.last, 1), time: 0, center: [0, 0], last: null };
    for (const [own, form] of Object.entries(FORMS)) {
      const isLast = isAlike(last, form.step(form.empty ?? [1, 0, 0, 0], facts, filled({})));
      if (own === "multiply" && !isLast) continue;
      const shown = form.show(own === "multiply" ? last : total, facts), ofLast = isLast && own !== "multiply" ? form.show(totalOfStep(last), facts) : [];
      form.inputs.forEach((name, k) => this.showInput(form, name, Number.isFinite(shown[k]) ? shown[k] : ofLast[k], form.empty?.[k]));
    }
  }

  showInput(form, name, own, empty) {
    if (form.slides) fill(element(name), Number.isFinite(own) ? own : empty);
    this.showNumber(form.slides ? `${name}-value` : name, own);
  }
}
