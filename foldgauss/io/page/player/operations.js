// What an edit does: the actions of edit scripts (foldgauss.io.edit_script.ACTIONS) that a folded model holds exactly.
import { applyAffine, applyColors, applyFreeze, applyOpacity, applyRetiming, withColor, withHue } from "./parameters.js";
import { countOf, gathered, indicesOf } from "./state.js";
import { withTotals } from "./totals.js";

const IDENTITY = [[1, 0], [0, 1]];
const MOST_COPIES = 1000;
const MOST_GAUSSIANS = 1_000_000; // after multiply: a few hundred bytes each, in each state that is kept
const MOST_MAPS = 1_000_000; // of shared paths after multiply, 56 bytes each

const isNumber = (own) => typeof own === "number" && Number.isFinite(own) && Math.abs(own) <= 1e9;
const isList = (length, of = isNumber) => (own) => Array.isArray(own) && own.length === length && own.every(of);
const isMany = (of) => (own) => Array.isArray(own) && own.length > 0 && own.length <= MOST_COPIES && own.every(of);
const either = (...ways) => (own) => ways.some((way) => way(own));
const positive = (own) => isNumber(own) && own > 0;

const NUMBER = ["a number", isNumber], PAIR = ["two numbers", isList(2)], THREE = ["three numbers", isList(3)];
const POSITIVE = ["a number > 0, or two", either(positive, isList(2, positive))];
const ONE_OR_THREE = ["a number, or three", either(isNumber, isList(3))];
const EACH = ["a number, or one for each copy", either(isNumber, isMany(isNumber))];

const turn = (degrees) => {
  const angle = (degrees * Math.PI) / 180;
  return [[Math.cos(angle), -Math.sin(angle)], [Math.sin(angle), Math.cos(angle)]];
};
const three = (value, otherwise) => (value === undefined ? otherwise : isNumber(value) ? [value, value, value] : value);

/** Move, turn or enlarge about a fixed point. */
const affine = (state, matrix, about = [0, 0], offset = [0, 0]) => applyAffine(state, matrix, about, offset);

function scaled(state, factor, about) {
  const [x, y] = isNumber(factor) ? [factor, factor] : factor;
  return affine(state, [[x, 0], [0, y]], about);
}

/** The color map of a `recolor`, which may depend on the selections of all `states` together. */
function colorMap({ color, hue, gain, offset, matrix }, states) {
  if (color !== undefined) return withColor(states, color);
  if (hue !== undefined) return withHue(hue);
  const gains = three(gain, [1, 1, 1]), shift = three(offset, [0, 0, 0]), rows = matrix ?? [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  return (own) => rows.map((row, c) => gains[c] * (row[0] * own[0] + row[1] * own[1] + row[2] * own[2]) + shift[c]);
}

function ordered(state, selectedFirst) {
  const chosen = indicesOf(state), others = [];
  for (let i = 0; i < state.model.num; i++) if (!state.selected[i]) others.push(i);
  const source = selectedFirst ? chosen.concat(others) : others.concat(chosen);
  return gathered(state, source, Uint8Array.from(source, (i) => state.selected[i]));
}

/** Refuse more Gaussians than can be held. */
export function checkTotal(total) {
  if (total > MOST_GAUSSIANS) throw new Error(`offsets: expected at most ${MOST_GAUSSIANS.toLocaleString("en")} Gaussians with the copies, got ${total.toLocaleString("en")}. Select fewer, or make fewer copies.`);
}

/** Copies, each just behind what it is a copy of; they are the selection then, with the originals if asked for. */
function multiplied(state, { offsets, delays = 0, scale = 1, degrees = 0, about, originals = false }) {
  checkTotal(state.model.num + countOf(state) * offsets.length);
  const { count, knots } = state.model.paths ?? { count: 0, knots: 0 };
  if (count * knots * (offsets.length + 1) > MOST_MAPS) throw new Error(`offsets: expected fewer copies of ${count.toLocaleString("en")} shared paths with ${knots.toLocaleString("en")} maps each, got ${offsets.length}.`);
  const source = [], copy = [];
  for (let i = 0; i < state.model.num; i++)
    for (let k = 0; k <= (state.selected[i] ? offsets.length : 0); k++) {
      source.push(i);
      copy.push(k);
    }
  const each = (own, k) => (isNumber(own) ? own : own[k]);
  let after = gathered(state, source, new Uint8Array(source.length));
  const selected = Uint8Array.from(copy, (k) => (k > 0 ? 1 : 0));
  offsets.forEach((offset, k) => {
    after = { ...after, selected: Uint8Array.from(copy, (own) => (own === k + 1 ? 1 : 0)) };
    if (each(scale, k) !== 1) after = applyStep(after, { do: "scale", factor: each(scale, k), about });
    if (each(degrees, k) !== 0) after = applyStep(after, { do: "rotate", degrees: each(degrees, k), about });
    after = applyStep(after, { do: "move", offset });
    if (each(delays, k) !== 0) after = applyStep(after, { do: "retime", shift: each(delays, k) });
  });
  return { ...after, selected: originals ? Uint8Array.from(source, (i, k) => Math.max(state.selected[i], selected[k])) : selected };
}

function vanished(state) {
  const kept = [];
  for (let i = 0; i < state.model.num; i++) if (!state.selected[i]) kept.push(i);
  return gathered(state, kept, new Uint8Array(kept.length));
}

const CENTER = "The page turns and enlarges about a fixed point: give about = [x, y], or render the script with foldgauss edit.";

/**
 * By `do`: `needed` and `optional` keys as [what is expected, whether a value is], a `check` of keys that go together,
 * which returns what is wrong, and `apply(state, keys, context)`. Of `context`: `frameTime(position)`, and `states`, those
 * of all segments. `timed`: it depends on the clip's time.
 */
export const ACTIONS = {
  move: { needed: { offset: PAIR }, apply: (state, { offset }) => affine(state, IDENTITY, [0, 0], offset) },
  scale: { needed: { factor: POSITIVE }, optional: { about: PAIR }, check: ({ about }) => (about ? "" : CENTER), apply: (state, { factor, about }) => scaled(state, factor, about) },
  rotate: { needed: { degrees: NUMBER }, optional: { about: PAIR }, check: ({ about }) => (about ? "" : CENTER), apply: (state, { degrees, about }) => affine(state, turn(degrees), about) },
  transform: {
    needed: { matrix: ["two rows of two numbers", isList(2, isList(2))] }, optional: { offset: PAIR, about: PAIR },
    check: ({ matrix: [[a, b], [c, d]], about }) => (!about ? CENTER : a * d - b * c === 0 ? "matrix: expected an invertible one. Use vanish to delete." : ""),
    apply: (state, { matrix, offset, about }) => affine(state, matrix, about, offset),
  },
  multiply: {
    needed: { offsets: ["pairs of numbers", isMany(isList(2))] },
    optional: { delays: EACH, scale: EACH, degrees: EACH, about: PAIR, originals: ["true or false", (own) => typeof own === "boolean"] },
    check: ({ offsets, delays = 0, scale = 1, degrees = 0, about }) => {
      for (const [name, own] of Object.entries({ delays, scale, degrees })) if (Array.isArray(own) && own.length !== offsets.length) return `${name}: expected one for each of ${offsets.length} copies, got ${own.length}.`;
      if ([scale].flat().some((own) => !(own > 0))) return "scale: expected numbers > 0.";
      return about || ([scale].flat().every((own) => own === 1) && [degrees].flat().every((own) => own === 0)) ? "" : CENTER;
    },
    apply: multiplied,
  },
  vanish: { apply: vanished },
  opacity: {
    needed: { factor: ["a number >= 0", (own) => isNumber(own) && own >= 0] },
    apply: (state, { factor }) => (factor === 0 ? vanished(state) : applyOpacity(state, factor)),
  },
  recolor: {
    optional: { color: THREE, hue: NUMBER, gain: ONE_OR_THREE, offset: ONE_OR_THREE, matrix: ["three rows of three numbers", isList(3, isList(3))] },
    check: ({ color, hue, gain, offset, matrix }) => {
      const ways = (color !== undefined) + (hue !== undefined) + (gain !== undefined || offset !== undefined || matrix !== undefined);
      if (ways !== 1) return "expected color, or hue, or gain, offset and matrix.";
      if (hue !== undefined && !(hue >= 0 && hue <= 1)) return "hue: expected turns from 0 to 1. Divide degrees by 360.";
      return color?.some((own) => own < 0 || own > 1) ? "color: expected red, green and blue from 0 to 1." : "";
    },
    apply: (state, keys, { states }) => applyColors(state, colorMap(keys, states)),
  },
  retime: {
    optional: { shift: NUMBER, stretch: NUMBER, about: NUMBER }, timed: true,
    check: ({ stretch = 1 }) => (stretch === 0 ? "stretch: expected a number other than 0. To stop time use freeze." : ""),
    apply: (state, { shift = 0, stretch = 1, about = 0 }) => applyRetiming(state, shift, stretch, about),
  },
  freeze: {
    needed: { at: ["a frame >= 0", (own) => isNumber(own) && own >= 0] }, timed: true,
    apply: (state, { at }, { frameTime }) => applyFreeze(state, frameTime(at)),
  },
  to_front: { apply: (state) => ordered(state, true) },
  to_back: { apply: (state) => ordered(state, false) },
};

/** Keys of a step besides the action's own; they limit an edit to a span of time. */
const SPANS = ["frame", "frames", "times", "ease", "curve"];

/** What is wrong with a step {do, ...keys}; "" if nothing. */
export function problemOf(step) {
  const action = Object.hasOwn(ACTIONS, step.do) ? ACTIONS[step.do] : null;
  if (!action) return `do: expected one of ${Object.keys(ACTIONS).join(", ")}, got ${JSON.stringify(step.do)}.`;
  const known = { ...action.needed, ...action.optional };
  for (const key of Object.keys(action.needed ?? {})) if (!(key in step)) return `${key}: expected ${known[key][0]}, got none.`;
  for (const [key, value] of Object.entries(step)) {
    if (key === "do") continue;
    if (SPANS.includes(key)) return `${key}: expected an edit at all times, which a folded model holds. Render the script with foldgauss edit.`;
    if (!Object.hasOwn(known, key)) return `${key}: expected one of ${Object.keys(known).join(", ") || "no keys"}.`;
    if (!known[key][1](value)) return `${key}: expected ${known[key][0]}, got ${JSON.stringify(value)}.`;
  }
  return action.check?.(step) ?? "";
}

/** The state after a step; the same one if nothing is selected. */
export function applyStep(state, step, context) {
  const { do: name, ...keys } = step;
  return countOf(state) ? withTotals(ACTIONS[name].apply(state, keys, context), step) : state;
}
