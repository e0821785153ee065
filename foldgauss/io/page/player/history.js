// The edit: a list of steps, of which the first `done` are in effect. The picture, the script and what the browser keeps
// follow from it alone.

/**
 * A step is one of
 * - {select: {number: ranges, ...}}: the whole selection, of the file's Gaussians, by segment;
 * - an edit with the keys of an edit script, as {do: "move", offset: [0.1, 0]}, of what is selected then;
 * - {script: [steps]}: these instead of all that was before, as by opening a script; empty for starting afresh.
 */
export class History {
  constructor() {
    this.steps = [];
    this.done = 0;
    this.onChange = () => {};
  }

  /** The steps in effect, without those that a script replaced. */
  get current() {
    return inEffect(this.steps.slice(0, this.done));
  }

  get last() {
    return this.steps[this.done - 1];
  }

  get canUndo() {
    return this.done > 0;
  }

  get canRedo() {
    return this.done < this.steps.length;
  }

  /** Add a step; what had been undone is gone then. */
  push(step) {
    this.steps.splice(this.done, Infinity, step);
    this.done = this.steps.length;
    this.onChange();
  }

  /** Put another step in place of the last one, as while a slider moves. */
  amend(step) {
    this.steps.splice(this.done - 1, Infinity, step);
    this.onChange();
  }

  undo() {
    this.goTo(this.done - 1);
  }

  redo() {
    this.goTo(this.done + 1);
  }

  goTo(done) {
    if (done < 0 || done > this.steps.length) return;
    this.done = done;
    this.onChange();
  }

  /** Replace the whole history, as by that of an earlier visit. */
  restore({ steps, done }) {
    [this.steps, this.done] = [steps, done];
    this.onChange();
  }
}

/** Steps without those that a script among them replaced. */
export function inEffect(steps) {
  const from = steps.findLastIndex((step) => step.script);
  return from < 0 ? steps : [...steps[from].script, ...steps.slice(from + 1)];
}
