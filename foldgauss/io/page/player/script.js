// An edit as a script for `foldgauss edit`, and back: selections by indices, and the steps as tables [[edits]].
import { fromRanges, toRanges } from "./indices.js";
import { ACTIONS, problemOf } from "./operations.js";
import { LINE, parseToml } from "./toml.js";

/** Selections that are not the operand of an edit, but what is selected at the end. */
const CURRENT = "current";
const RENDER = "Render the script with foldgauss edit.";

/** The text of a script; `counts`: the number of Gaussians of each segment. */
export function writeScript(steps, counts, title) {
  const selections = [], edits = [];
  let select, name; // the last selection, and its name once an edit has used it
  for (const step of steps) {
    if (step.select) [select, name] = [step.select, undefined];
    else if (select && Object.keys(select).length) {
      const begins = name === undefined;
      if (begins) selections.push(selectionTables((name = `s${selections.length + 1}`), select, counts));
      edits.push(editTable(step, begins ? name : undefined));
      if (step.do === "vanish" || step.factor === 0) select = undefined; // what was selected is gone: later edits change nothing
    }
  }
  if (select && name === undefined && Object.keys(select).length) selections.push(selectionTables(CURRENT, select, counts));
  const printable = title.replace(/\p{Cc}/gu, " "); // comments of TOML hold no control characters
  const about = `# An edit of ${JSON.stringify(printable)} by the foldgauss player. To apply it:\n# foldgauss edit MODEL THIS_FILE --out edited.safetensors\n`;
  return [about, ...selections, ...edits].join("\n");
}

function selectionTables(name, select, counts) {
  const tables = Object.entries(select).map(([number, ranges]) => {
    const own = counts.length > 1 ? `${name}_${number}` : name, segment = counts.length > 1 ? `segment = ${number}\n` : "";
    return [own, `[selections.${own}]\nindices = "${ranges}"\n${segment}num_gaussians = ${counts[number]}\n`];
  });
  const texts = tables.map(([, text]) => text);
  if (counts.length > 1) texts.push(`[selections.${name}]\nany = ${JSON.stringify(tables.map(([own]) => own))}\n`);
  return texts.join("\n");
}

function editTable({ do: action, ...keys }, select) {
  const lines = Object.entries(keys).map(([key, value]) => `${key} = ${JSON.stringify(value)}\n`);
  return `[[edits]]\n${select ? `select = "${select}"\n` : ""}do = "${action}"\n${lines.join("")}`;
}

/** The steps of a script. Throws an Error for display where the page cannot do what it says. */
export function readScript(text, counts) {
  const tables = parseToml(text);
  for (const key of Object.keys(tables))
    if (key === "layers" || key === "camera") throw new Error(`[${key}]: expected selections and edits, which the page can do. ${RENDER}`);
    else if (key !== "selections" && key !== "edits") throw new Error(`expected the tables selections and edits, got ${JSON.stringify(key)}.`);
  const named = new Map();
  for (const [name, own] of Object.entries(tables.selections ?? {}))
    within(`[selections.${name}]`, own, () => named.set(name, resolve(own, named, counts)));
  const steps = [], choose = (masks) => steps.push({ select: asStep(masks) });
  if (tables.edits !== undefined && !Array.isArray(tables.edits)) throw new Error("edits: expected tables, each begun by [[edits]].");
  (tables.edits ?? []).forEach((own, k) =>
    within(`[[edits]] number ${k + 1}`, own, () => {
      const { select, ...step } = own;
      if (select !== undefined && !named.has(select)) throw new Error(`select: expected the name of a selection, got ${JSON.stringify(select)}.`);
      const problem = problemOf(step);
      if (problem) throw new Error(problem);
      if (counts.length > 1 && (ACTIONS[step.do].timed || step.delays || step.color)) throw new Error(`${step.do}: expected an edit that needs one segment alone. ${RENDER}`);
      if (select !== undefined) choose(named.get(select));
      else if (k === 0) choose(counts.map((num) => new Uint8Array(num).fill(1)));
      steps.push({ ...step });
    }),
  );
  if (named.has(CURRENT)) choose(named.get(CURRENT));
  return steps;
}

function within(where, own, does) {
  try {
    does();
  } catch (error) {
    throw new Error(`line ${own[LINE]}, ${where}: ${error.message}`);
  }
}

/** A mask of each segment. */
function resolve(own, named, counts) {
  if ("indices" in own) return resolveIndices(own, counts);
  const keys = Object.keys(own), other = keys.find((key) => !["any", "all", "without"].includes(key));
  if (other || !keys.length) throw new Error(`${other ?? "table"}: expected indices, or any, all and without: the page cannot look at ${other ?? "nothing"}. ${RENDER}`);
  const masks = (names) => [names].flat().map((name) => named.get(name) ?? fail(`expected a selection from before, got ${JSON.stringify(name)}.`));
  const combine = (lists, operate) => lists.reduce((all, one) => all.map((mask, n) => mask.map((bit, i) => operate(bit, one[n][i]))));
  const everything = counts.map((num) => new Uint8Array(num).fill(1));
  let found = own.any ? combine(masks(own.any), (a, b) => a | b) : everything;
  if (own.all) found = combine([found, ...masks(own.all)], (a, b) => a & b);
  return own.without ? combine([found, ...masks(own.without)], (a, b) => a & ~b & 1) : found;
}

function fail(message) {
  throw new Error(message);
}

function resolveIndices({ indices, num_gaussians: num, segment = 0, ...rest }, counts) {
  const [other] = Object.keys(rest);
  if (other) fail(`${other}: expected indices alone, with num_gaussians and segment. ${RENDER}`);
  if (typeof indices !== "string" || indices === "") fail('indices: expected a text of numbers and ranges, as "3,17,40-52".');
  if (!Number.isInteger(segment) || !(segment >= 0 && segment < counts.length)) fail(`segment: expected a number below ${counts.length}, got ${segment}.`);
  if (num !== undefined && num !== counts[segment]) fail(`num_gaussians: expected ${counts[segment]}, those of this model, got ${num}. Open the model that the script was made for.`);
  return counts.map((own, number) => (number === segment ? fromRanges(indices, own) : new Uint8Array(own)));
}

function asStep(masks) {
  return Object.fromEntries(masks.map((mask, number) => [number, toRanges(mask)]).filter(([, ranges]) => ranges !== ""));
}
