// Keys of the whole page.
import { MODES } from "./panes.js";
import { openDialog, openHelp, toggleFull, toggleTheme } from "./shell.js";

/** Keys by what they do; `parts`: the controls that do it. */
function makeKeys({ player, transport, panes, pointers, panel, tools, handles, files }) {
  const edits = (does) => () => player.highlighting && does();
  const choose = (name) => () => {
    if (!player.highlighting) panel.toggle(true);
    tools.choose(name);
  };
  const keys = {
    " ": () => player.toggle(), k: () => player.toggle(),
    arrowleft: (event) => transport.skip(-1, event.shiftKey), arrowright: (event) => transport.skip(1, event.shiftKey),
    ",": () => player.step(-1), ".": () => player.step(1),
    home: () => player.seekPosition(0), end: () => player.seekPosition(player.timeline.last),
    "[": () => transport.changeSpeed(-1), "]": () => transport.changeSpeed(1), "<": () => transport.changeSpeed(-1), ">": () => transport.changeSpeed(1),
    l: () => transport.toggleLoop(), "0": () => panes.reset(), "+": () => pointers.zoom(1.25), "=": () => pointers.zoom(1.25), "-": () => pointers.zoom(0.8),
    f: toggleFull, t: toggleTheme, "?": openHelp, s: () => openDialog("files"),
    e: () => panel.toggle(), b: choose("brush"), r: choose("rectangle"), a: choose("lasso"), p: choose("polygon"), i: choose("eyedropper"),
    v: choose("transform"), h: choose("hand"), g: edits(() => tools.grow()), "shift+g": edits(() => tools.shrink()), d: edits(() => panel.duplicate()),
    delete: edits(() => panel.remove()), backspace: edits(() => (tools.points.length ? tools.removeCorner() : panel.remove())),
    enter: edits(() => tools.points.length > 2 && tools.finish()),
    z: () => panel.undo(), "shift+z": () => panel.redo(),
    "ctrl+z": () => panel.undo(), "ctrl+shift+z": () => panel.redo(), "ctrl+y": () => panel.redo(),
    "ctrl+a": edits(() => tools.selectAll()), "ctrl+shift+a": edits(() => tools.selectNone()), "ctrl+i": edits(() => tools.invert()),
    "ctrl+s": () => files.save(), "ctrl+o": () => files.choose(),
    escape: () => (tools.points.length ? tools.cancel() : panel.toggle(false)),
  };
  for (const [name, x, y] of [["left", -1, 0], ["right", 1, 0], ["up", 0, -1], ["down", 0, 1]]) {
    keys[`alt+arrow${name}`] = edits(() => panel.hasSelection && handles.nudge(x, y));
    keys[`alt+shift+arrow${name}`] = edits(() => panel.hasSelection && handles.nudge(10 * x, 10 * y));
  }
  MODES.forEach((mode, k) => (keys[k + 1] = () => panes.setMode(mode)));
  return keys;
}

/** The name of a key with the modifiers that count. */
function nameOf(event) {
  const key = event.key.toLowerCase(), shift = event.shiftKey && (key.length > 1 || /[a-z]/.test(key));
  return `${event.ctrlKey || event.metaKey ? "ctrl+" : ""}${event.altKey ? "alt+" : ""}${shift ? "shift+" : ""}${key}`;
}

/** Keys that a number field takes itself: digits, signs, e, what moves in it and deletes, and Ctrl with a, c, v, x. */
const OF_NUMBERS = /^(ctrl\+[acvx]|(shift\+)?([\de+\-.,=]|arrow\w+|home|end|delete|backspace))$/;

export function bindKeys(parts) {
  const keys = makeKeys(parts);
  document.addEventListener("keydown", (event) => {
    const name = nameOf(event);
    if (document.querySelector("dialog[open]") && !/^ctrl\+[os]$/.test(name)) return;
    const { target } = event, does = keys[name] ?? (event.ctrlKey || event.altKey ? undefined : keys[name.replace("shift+", "")]);
    if (!does) return;
    const typing = target.matches?.("input[type=number]") && OF_NUMBERS.test(name);
    const sliding = target.matches?.("input[type=range]:not(#scrub), select") && /^(shift\+)?(arrow|home|end)/.test(name);
    if (typing || sliding || (target.matches?.("button, select") && (event.key === " " || event.key === "Enter"))) return;
    event.preventDefault();
    does(event);
  });
}
