// A state of an edit: the Gaussians as edited, which of them are selected, which of the file's each one stems from, and
// what its edits add up to.
import { TEXTURE_WIDTH, WIDTHS, fillTexels } from "./gaussians.js";
import { beginTotals } from "./totals.js";

/** The state before any edit, with nothing selected. */
export function begin(model) {
  const { num } = model;
  return { model, selected: new Uint8Array(num), origin: Uint32Array.from({ length: num }, (_, i) => i), ...beginTotals(num) };
}

const sum = (mask) => mask.reduce((total, own) => total + own, 0);
const counts = new WeakMap(), fileCounts = new WeakMap(); // by selection, which is never changed in place

/** How many Gaussians are selected. */
export function countOf({ selected }) {
  if (!counts.has(selected)) counts.set(selected, sum(selected));
  return counts.get(selected);
}

/** How many of the file's `num` Gaussians are selected: copies of one count once. */
export function fileCountOf(state, num) {
  if (!fileCounts.has(state.selected)) fileCounts.set(state.selected, sum(originalsOf(state, num)));
  return fileCounts.get(state.selected);
}

/** The selected Gaussians' indices. */
export function indicesOf({ selected }) {
  const found = [];
  for (let i = 0; i < selected.length; i++) if (selected[i]) found.push(i);
  return found;
}

/** The same Gaussians with another selection, given for the Gaussians of the file. */
export const withOriginals = (state, mask) => ({ ...state, selected: Uint8Array.from(state.origin, (i) => mask[i]) });

/** The selection as one of the Gaussians of the file. */
export function originalsOf(state, num) {
  const mask = new Uint8Array(num);
  for (let k = 0; k < state.selected.length; k++) if (state.selected[k]) mask[state.origin[k]] = 1;
  return mask;
}

/**
 * The state with new values in the named leaves of the selected Gaussians, those that `change(leaves, i)` writes. All
 * other leaves are shared with the state before, so that undoing needs no memory. `moved`: their new shared paths, of
 * `changedPaths`.
 */
export function withChanged(state, names, change, moved = null) {
  const { model } = state, leaves = { ...model.leaves }, { path_index: index } = leaves, paths = moved?.paths ?? model.paths;
  for (const name of moved ? [...names, "path_index"] : names) leaves[name] = leaves[name].slice();
  const values = model.values.slice();
  for (const i of indicesOf(state)) {
    change(leaves, i);
    if (moved) leaves.path_index[i] = moved.numbers[index[i]];
    fillTexels(values, i, leaves, model.texels, model.degree);
  }
  return { ...state, model: { ...model, leaves, values, paths } };
}

/** The state without the Gaussians that were moved in time so far beyond the clip that no image of it has them. */
export function withoutUnseen(state) {
  const { num, leaves: { time_loc: times }, windows } = state.model, kept = [];
  for (let i = 0; i < num; i++) if ((times[i] > 0 && times[i] < 1) || (windows[2 * i] < 1 && windows[2 * i + 1] > 0)) kept.push(i);
  return kept.length === num ? state : gathered(state, kept, Uint8Array.from(kept, (i) => state.selected[i]));
}

/** The state of the Gaussians at the indices `source`, which may repeat or leave some out, with this selection. */
export function gathered(state, source, selected) {
  const { model } = state, { degree, texels } = model, num = source.length;
  const take = (from, width, into = new from.constructor(num * width)) => {
    for (let k = 0; k < num; k++) for (let c = 0; c < width; c++) into[k * width + c] = from[source[k] * width + c];
    return into;
  };
  const rows = Math.ceil((num * texels) / TEXTURE_WIDTH);
  const leaves = Object.fromEntries(Object.entries(WIDTHS).filter(([name]) => model.leaves[name]).map(([name, width]) => [name, take(model.leaves[name], width(degree))]));
  const values = take(model.values, 4 * texels, new Float32Array(4 * TEXTURE_WIDTH * rows));
  const changed = { ...model, num, rows, leaves, values, windows: take(model.windows, 2) };
  return { model: changed, selected, origin: take(state.origin, 1), totals: state.totals, rows: take(state.rows, 1) };
}
