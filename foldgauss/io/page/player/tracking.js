// Following a selection through the clip: a new Gaussian takes the label of those of its color that cover its center.
import { alphaAt } from "./gaussians.js";

const SAME_COLOR = 0.02; // variance of color differences
const SELECTED = 1, OTHER = 2;

/** Similarity of the colors of two Gaussians, 0 to 1. */
function colorSimilarity({ values, texels }, i, j) {
  const at = 4 * texels * i + 8, other = 4 * texels * j + 8;
  let square = 0;
  for (let c = 0; c < 3; c++) square += (values[at + c] - values[other + c]) ** 2;
  return Math.exp((-0.5 * square) / SAME_COLOR);
}

/**
 * The mask of a state's Gaussians that belong to what is selected at `time`, found frame by frame away from it. Awaits
 * `onProgress(fraction)` now and then, so that the page stays responsive; stops with null once that returns false.
 */
export async function follow(picker, state, time, times, onProgress) {
  const before = times.filter((t) => t < time).reverse(), after = times.filter((t) => t > time);
  const known = new Uint8Array(state.model.num);
  for (const { i } of picker.at(state, time)) known[i] = state.selected[i] ? SELECTED : OTHER;
  let done = 0;
  for (const way of [after, before])
    for (const t of way) {
      labelFrame(picker, state, t, known);
      if (++done % 4 === 0 && (await onProgress(done / (before.length + after.length))) === false) return null;
    }
  return known.map((own) => (own === SELECTED ? 1 : 0));
}

/** Label the unknown Gaussians alive at a time by a vote of the known ones. */
function labelFrame(picker, state, time, known) {
  const all = picker.at(state, time), labeled = all.filter((one) => known[one.i]), grid = picker.grid(labeled, state), found = [];
  for (const one of all) {
    if (known[one.i]) continue;
    const votes = [0, 1e-3, 0];
    for (const place of grid.near(one.x, one.y)) {
      const other = labeled[place];
      votes[known[other.i]] += alphaAt(other, one.x, one.y) * colorSimilarity(state.model, one.i, other.i);
    }
    found.push([one.i, votes[SELECTED] > votes[OTHER] && votes[SELECTED] > 0.02 ? SELECTED : OTHER]);
  }
  for (const [i, label] of found) known[i] = label;
}
