// The edit of each model that was opened, kept in the browser until it is discarded: under the model's fingerprint.
import { recall, remember } from "./elements.js";
import { problemOf } from "./operations.js";

const PREFIX = "foldgauss-edit-", PAUSE = 400; // milliseconds after a change

/** Whether a value is a step of a history, as far as can be told without the model. */
const isStep = (step) => Array.isArray(step?.script) ? step.script.every(isStep) : step?.select ? typeof step.select === "object" : step?.do !== undefined && problemOf(step) === "";

export class Storage {
  /** `onInvalid(error)` is called for an edit that cannot be applied, `onFull` when the browser does not keep an edit. */
  constructor(onInvalid, onFull) {
    Object.assign(this, { onInvalid, onFull });
    addEventListener("pagehide", () => this.flush());
    document.addEventListener("visibilitychange", () => document.hidden && this.flush());
  }

  /**
   * Restore the history of a model, if there is one; from now on keep it, with the `version` of the script on the disk
   * that it began with or was saved as. What `check(steps)` throws for is forgotten. Whether something can be undone, and whether it `isCurrent`: of that version.
   */
  attach(fingerprint, history, check) {
    this.flush();
    this.history = history;
    this.key = PREFIX + fingerprint;
    this.told = false;
    let kept = null;
    try {
      kept = JSON.parse(recall(this.key));
    } catch {
      // not ours
    }
    if (!Array.isArray(kept?.steps) || !kept.steps.every(isStep) || !(kept.done >= 0 && kept.done <= kept.steps.length)) return {};
    try {
      check(kept.steps);
    } catch (error) {
      remember(this.key, null);
      this.onInvalid(error);
      return {};
    }
    history.restore(kept);
    return { canUndo: history.canUndo, isCurrent: kept.version === this.version };
  }

  changed() {
    this.pending ??= setTimeout(() => this.flush(), PAUSE);
  }

  flush() {
    clearTimeout(this.pending);
    if (this.pending === undefined) return;
    this.pending = undefined;
    const { version, history: { steps, done } } = this;
    const kept = steps.length ? remember(this.key, JSON.stringify({ steps, done, version })) : remember(this.key, null);
    if (!kept && !this.told) this.onFull();
    this.told = !kept; // once, until it works again
  }
}
