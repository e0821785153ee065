// The Gaussians of each segment as edited: states that follow from the history.
import { History, inEffect } from "./history.js";
import { fromRanges, toRanges } from "./indices.js";
import { applyStep } from "./operations.js";
import { checkSize } from "./sizes.js";
import { begin, countOf, fileCountOf, originalsOf, withOriginals } from "./state.js";

/** States kept from the last steps, so that undoing and sliders begin there. */
const KEPT = 8;

/** The selection after an operation on masks of the file's Gaussians. */
const COMBINE = {
  new: (old, found) => found,
  add: (old, found) => old.map((own, i) => own | found[i]),
  subtract: (old, found) => old.map((own, i) => own & ~found[i] & 1),
  intersect: (old, found) => old.map((own, i) => own & found[i]),
};

export class Editing {
  /** `counts`: the number of Gaussians of each segment. */
  constructor(counts) {
    this.counts = counts;
    this.history = new History();
    this.history.onChange = () => this.onChange();
    this.chains = new Map(); // by segment: the model of the file, and [{step, state}] after each step
    this.draft = null; // {number, mask}: a selection that a stroke is still changing
    this.onChange = () => {};
  }

  /** The state of a segment whose model, as in the file, is `base`, after steps. */
  stateOf(number, base, steps = this.history.current) {
    let chain = this.chains.get(number);
    if (chain?.base !== base) this.chains.set(number, (chain = { base, begun: begin(base), links: [] }));
    const { links } = chain;
    let common = 0;
    while (common < links.length && common < steps.length && links[common].step === steps[common]) common++;
    links.length = common;
    while (common > 0 && !links[common - 1].state) common--; // it was dropped: apply again from an earlier one
    let state = common ? links[common - 1].state : chain.begun;
    for (let k = common; k < steps.length; k++) {
      state = this.apply(state, steps[k], number, base);
      links[k] = { step: steps[k], state };
    }
    for (let k = 0; k < links.length - KEPT; k++) links[k].state = null;
    return this.draft?.number === number ? withOriginals(state, this.draft.mask) : state;
  }

  apply(state, step, number, base) {
    if (step.select) return withOriginals(state, fromRanges(step.select[number] ?? "", base.num));
    return applyStep(state, step, { frameTime: (position) => interpolate(base.times, position), states: [state] });
  }

  /** Forget the states of segments that are no longer decoded. */
  forget(held) {
    for (const number of this.chains.keys()) if (!held.has(number)) this.chains.delete(number);
  }

  // ------------------------------------------------------------------------------------------ selections

  /** Selected Gaussians of the file, by segment, as text. */
  get selection() {
    return this.history.current.findLast((step) => step.select)?.select ?? {};
  }

  /** Select the Gaussians of a mask over a segment's current ones; `how`: new, add, subtract or intersect. */
  select(number, base, found, how = "new") {
    this.selectOriginals(number, this.combined(number, base, found, how));
  }

  combined(number, base, found, how) {
    const state = this.stateOf(number, base), originals = new Uint8Array(base.num);
    for (let k = 0; k < found.length; k++) if (found[k]) originals[state.origin[k]] = 1;
    return COMBINE[how](originalsOf(state, base.num), originals);
  }

  selectOriginals(number, mask) {
    const selection = { ...this.selection, [number]: toRanges(mask) };
    for (const [key, ranges] of Object.entries(selection)) if (ranges === "") delete selection[key];
    if (JSON.stringify(selection) !== JSON.stringify(this.selection) || !this.history.last?.select) this.history.push({ select: selection });
    else this.onChange();
  }

  selectNone() {
    this.history.push({ select: {} });
  }

  /** Begin a stroke, which changes the selection until it ends. */
  beginStroke(number, base) {
    this.draft = { number, base, mask: originalsOf(this.stateOf(number, base), base.num), changed: false };
  }

  /** Select or erase the Gaussians at these indices in the stroke. */
  paint(indices, erase) {
    const { number, base, mask } = this.draft, { origin } = this.stateOf(number, base), to = erase ? 0 : 1;
    for (const i of indices) {
      if (mask[origin[i]] === to) continue;
      mask[origin[i]] = to;
      this.draft.changed = true;
    }
  }

  endStroke() {
    const { draft } = this;
    this.draft = null;
    if (draft?.changed) this.selectOriginals(draft.number, draft.mask);
  }

  // ----------------------------------------------------------------------------------------------- edits

  /**
   * Add an edit of the selection, or change the one that was just added, if it is of the same kind. Throws an Error for
   * display where that is not possible; nothing is changed then.
   */
  edit(step, amend = false) {
    const { history } = this, amends = amend && isAlike(history.last, step), before = history.current.slice(0, amends ? -1 : undefined);
    if (step.do === "multiply") this.checkMultiply(before, step);
    if (amends) history.amend(step);
    else history.push(step);
  }

  checkMultiply(before, step) {
    this.counts.forEach((num, number) => {
      const { base } = this.chains.get(number) ?? {};
      if (base) this.apply(this.stateOf(number, base, before), step, number, base);
      else checkSize([...before, step], number, num);
    });
  }

  /** Replace the edit by the steps of a script; it can be undone. `held` and errors: as of `check`. */
  load(steps, held) {
    this.check([{ script: steps }], held);
    this.history.push({ script: steps });
  }

  /** Throw an Error for display where the steps of a history cannot be applied; `held`: {number: {base}}, segments decoded. */
  check(steps, held) {
    const ends = steps.map((_, k) => k + 1).filter((k) => k === steps.length || steps[k].script); // of all that undo leads to
    for (const own of ends.map((end) => inEffect(steps.slice(0, end))))
      this.counts.forEach((num, number) => {
        const { base } = held.get(number) ?? {};
        if (base) own.reduce((state, step) => this.apply(state, step, number, base), begin(base));
        else checkSize(own, number, num);
      });
  }

  /** How many of a segment's current Gaussians are selected. */
  count(number, base) {
    return countOf(this.stateOf(number, base));
  }

  /** How many of a segment's Gaussians in the file they stem from. */
  fileCount(number, base) {
    return fileCountOf(this.stateOf(number, base), base.num);
  }
}

/** Whether two edits differ in values alone. */
export const isAlike = (one, other) => Boolean(one?.do) && Object.keys(one).join() === Object.keys(other).join() && one.do === other.do;

/** The time of a frame position, straight between frames, as freeze() takes it. */
function interpolate(times, position) {
  const held = Math.min(Math.max(position, 0), times.length - 1), k = Math.min(Math.floor(held), Math.max(times.length - 2, 0));
  return times.length === 1 ? times[0] : times[k] + (held - k) * (times[k + 1] - times[k]);
}
