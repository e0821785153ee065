// What the edits of each Gaussian add up to, as the panel's numbers show it: moves, turns and delays are sums, factors products.

/** Before any edit. Of the hue nothing is known until one is given. */
const START = { right: 0, down: 0, scale: 1, degrees: 0, hue: NaN, gain: 1, opacity: 1, shift: 0, speed: 1 };
const EQUAL = 1e-6; // sums and products by different ways

/** The number that one or several are, if they are equal. */
const oneOf = (own) => ([own].flat().every((other) => other === [own].flat()[0]) ? [own].flat()[0] : NaN);

/** By `do`: what a step changes in a total. NaN: no one number tells it. */
const CHANGES = {
  move: ({ right, down }, { offset: [x, y] }) => ({ right: right + x, down: down + y }),
  scale: ({ scale }, { factor }) => ({ scale: scale * oneOf(factor) }),
  rotate: (own, { degrees }) => ({ degrees: own.degrees + degrees }),
  transform: () => ({ right: NaN, down: NaN, scale: NaN, degrees: NaN }),
  opacity: ({ opacity }, { factor }) => ({ opacity: opacity * factor }),
  recolor: ({ gain }, { hue, gain: factor = NaN, offset, matrix }) => {
    if (hue !== undefined) return { hue };
    const isGain = offset === undefined && matrix === undefined && Number.isFinite(oneOf(factor));
    return isGain ? { gain: gain * oneOf(factor) } : { hue: NaN, gain: NaN };
  },
  retime: (own, { shift = 0, stretch = 1 }) => ({ shift: own.shift + shift, speed: own.speed / stretch }),
};

/** Totals of a state before any edit: a table, and each Gaussian's row in it. */
export const beginTotals = (num) => ({ totals: [START], rows: new Uint32Array(num) });

const after = (total, step) => ({ ...total, ...CHANGES[step.do]?.(total, step) });

/** The state with a step counted in the totals of the selected Gaussians. */
export function withTotals(state, step) {
  if (!CHANGES[step.do]) return state;
  const { selected } = state, rows = state.rows.slice(), totals = [...state.totals], moved = new Map();
  for (let i = 0; i < rows.length; i++) {
    if (!selected[i]) continue;
    if (!moved.has(rows[i])) moved.set(rows[i], totals.push(after(totals[rows[i]], step)) - 1);
    rows[i] = moved.get(rows[i]);
  }
  return { ...state, totals, rows };
}

const known = new WeakMap(); // by state, which is never changed in place

/** The total of the selected Gaussians; NaN where they differ. */
export function totalOf(state) {
  if (!known.has(state)) known.set(state, common(state));
  return known.get(state);
}

function common({ selected, rows, totals }) {
  const found = new Set();
  for (let i = 0; i < rows.length; i++) if (selected[i]) found.add(rows[i]);
  const [first = START, ...others] = [...found].map((row) => totals[row]);
  const isCommon = (name, own) => others.every((other) => Math.abs(other[name] - own) <= EQUAL * (1 + Math.abs(own)));
  return Object.fromEntries(Object.entries(first).map(([name, own]) => [name, isCommon(name, own) ? own : NaN]));
}

/** The total of one step alone. */
export const totalOfStep = (step) => after(START, step);

/** A total with what it would be before any edit in place of what is not known. */
export const filled = (total) => Object.fromEntries(Object.entries(START).map(([name, own]) => [name, Number.isFinite(total[name]) ? total[name] : own]));
