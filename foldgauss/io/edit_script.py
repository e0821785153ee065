"""Edits as a text: a TOML file that selects and changes objects of a video, checked with the line of each mistake.

Schema, every table optional; paths are relative to the script, angles in degrees, else the units of `Edit`:

- `[selections.NAME]`: `mask` (an image, folder or video, with `label`, `level`) or `file` (of `save_selection`), or
  `box`, `polygon`, `color`, `click`, `times`, with `frame`, `frames`, `tolerance`, `alive`, `threshold`, `follow`, as
  `foldgauss.video.select` takes them; or `any`, `all`, `without`: names given before, united, intersected, left
  out. All are found in the video as it was before the first edit.
- `[[edits]]`, in their order: `do` is one of `ACTIONS`, `select` a name (without: what is selected as it stands, at
  first everything), and the action's own keys; `frame`, `frames` or `times` with `ease` and `curve` for when.
- `frames` is `[first, stop]`, or "first:stop" where either may be left out: "10:" goes on to the end.
- `[[layers]]`: other videos, `model` and `where` ("front" or "behind"), with `freeze` (a frame) or a `script` of
  their own; those behind from front to back.
- `[camera]`: `azimuth` and `elevation`, from the front; it sees all layers.
"""

import dataclasses
import difflib
import math
import operator
import os
import re
import tomllib
from collections.abc import Callable, Mapping
from functools import reduce
from pathlib import Path
from typing import Any

from foldgauss._runtime.checks import invalid
from foldgauss.io._toml_lines import key_lines
from foldgauss.io.media.masks import read_masks
from foldgauss.io.models.selections import load_selection
from foldgauss.io.models.video_model import load_video_model
from foldgauss.render import Camera
from foldgauss.video.editing.chain import Edit, edit
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.layering import layers
from foldgauss.video.segmented.segmented_edit import SegmentedEdit
from foldgauss.video.segmented.segmented_selection import SegmentedSelection
from foldgauss.video.segmented.segmented_video import SegmentedVideo
from foldgauss.video.selection.selectors import Selection

Video = VideoModel | EditedVideo | SegmentedVideo
Selected = Selection | SegmentedSelection
Chain = Edit | SegmentedEdit

#: The largest script that is read: tens of thousands of edits.
MAX_BYTES = 4_000_000
#: Parts of a dotted key; each costs the parser a table.
MAX_PARTS = 16
_DEEP_KEY = re.compile(rf"(?:[\w\"'-]+[ \t]*\.[ \t]*){{{MAX_PARTS}}}")
#: Beyond, a number is no place, time or angle, and its square overflows.
LARGEST = 1e9


class EditScriptError(ValueError):
    """A script that says what cannot be done; the message is one line: file, line, table, key, expected, got."""


@dataclasses.dataclass(frozen=True)
class _Kind:
    """What a key may hold."""

    expected: str
    holds: Callable[[Any], bool]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST  # so no NaN


def _is_whole(value: Any) -> bool:
    return _is_number(value) and isinstance(value, int) and value >= 0


def _is_range(value: Any) -> bool:
    """As the commands have it, "A:B", either left out."""
    return isinstance(value, str) and re.fullmatch("[0-9]{0,9}:[0-9]{0,9}", value) is not None


def _numbers(*lengths: int, is_one: Callable[[Any], bool] = _is_number) -> Callable[[Any], bool]:
    """A list of so many numbers; of any length but 0 if none is said."""
    return lambda value: (
        isinstance(value, list) and bool(value) and len(value) in (lengths or (len(value),)) and all(map(is_one, value))
    )


def _either(*ways: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: any(way(value) for way in ways)


def _rows(length: int, *counts: int) -> Callable[[Any], bool]:
    return _numbers(*counts, is_one=_numbers(length))


_NUMBER = _Kind("a number", _is_number)
_WHOLE = _Kind("a whole number >= 0", _is_whole)
_BOOL = _Kind("true or false", lambda value: isinstance(value, bool))
_TEXT = _Kind("a text in quotes", lambda value: isinstance(value, str) and bool(value))
_PATH = _Kind("a path in quotes", lambda value: isinstance(value, str) and bool(value) and "\0" not in value)
_PAIR = _Kind("two numbers, as [0.1, 0.2]", _numbers(2))
_FRAMES = _Kind(
    'two whole numbers, as [10, 20]: first, and the first beyond; or "10:", from there to the end',
    _either(_numbers(2, is_one=_is_whole), _is_range),
)
_THREE = _Kind("three numbers, as [0.9, 0.2, 0.1]", _numbers(3))
_PAIRS = _Kind("pairs of numbers, as [[0.1, 0.0], [0.2, 0.0]]", _rows(2))
_ONE_OR_TWO = _Kind("a number, or two as [1.5, 1.0]", _either(_is_number, _numbers(2)))
_ONE_OR_THREE = _Kind("a number, or three as [1.0, 0.9, 0.8]", _either(_is_number, _numbers(3)))
_EACH = _Kind("a number, or a list with one for each copy", _either(_is_number, _numbers()))
_NAMES = _Kind('a list of names of selections, as ["one", "other"]', _numbers(is_one=_TEXT.holds))

_Keys = Mapping[str, _Kind]

_WHEN: _Keys = {"frame": _WHOLE, "frames": _FRAMES, "times": _PAIR, "ease": _ONE_OR_TWO, "curve": _TEXT}
_COMBINED: _Keys = dict.fromkeys(("any", "all", "without"), _NAMES)
_MASK_FILE: _Keys = {"label": _WHOLE, "level": _NUMBER}
_CRITERIA: _Keys = {
    "mask": _PATH,
    "file": _PATH,
    "box": _Kind("four numbers, as [10, 20, 60, 80]", _numbers(4)),
    "polygon": _Kind("pairs of numbers, as [[10, 10], [60, 12], [30, 50]]", _rows(2)),
    "color": _THREE,
    "click": _PAIR,
    "times": _PAIR,
    "frame": _WHOLE,
    "frames": _FRAMES,
    "tolerance": _NUMBER,
    "alive": _BOOL,
    "threshold": _NUMBER,
    "follow": _BOOL,
}
_LAYER: _Keys = {"model": _PATH, "where": _TEXT, "freeze": _NUMBER, "script": _PATH}
_CAMERA: _Keys = {"azimuth": _NUMBER, "elevation": _NUMBER}
_TABLES = ("selections", "edits", "layers", "camera")


@dataclasses.dataclass(frozen=True)
class _Action:
    """A word for `do`: a method of `Edit`, the keys that it must and may have, and what the method calls some of them.

    What is called so is in degrees if its key is "degrees".
    """

    method: str
    needs: _Keys = dataclasses.field(default_factory=dict)
    takes: _Keys = dataclasses.field(default_factory=dict)
    named: Mapping[str, str] = dataclasses.field(default_factory=dict)
    spans: bool = True

    @property
    def keys(self) -> _Keys:
        return {**self.needs, **self.takes, **(_WHEN if self.spans else {})}

    def apply(self, edit: Chain, given: dict[str, Any]) -> Chain:
        given = {key: _radians(value) if key == "degrees" else value for key, value in given.items()}
        return getattr(edit, self.method)(**{self.named.get(key, key): value for key, value in given.items()})


#: What an edit can do, each a method of `foldgauss.video.Edit`.
ACTIONS = {
    "move": _Action("move", {"offset": _PAIR}),
    "scale": _Action("scale", {"factor": _ONE_OR_TWO}, {"about": _PAIR}),
    "rotate": _Action("rotate", {"degrees": _NUMBER}, {"about": _PAIR}, {"degrees": "angle"}),
    "transform": _Action(
        "transform",
        {"matrix": _Kind("two rows of two numbers, as [[1.0, 0.2], [0.0, 1.0]]", _rows(2, 2))},
        {"offset": _PAIR, "about": _PAIR},
    ),
    "multiply": _Action(
        "multiply",
        {"offsets": _PAIRS},
        {"delays": _EACH, "scale": _EACH, "degrees": _EACH, "about": _PAIR, "originals": _BOOL},
        {"degrees": "angle"},
    ),
    "vanish": _Action("vanish"),
    "opacity": _Action("opacity", {"factor": _NUMBER}),
    "recolor": _Action(
        "recolor",
        takes={
            "color": _THREE,
            "hue": _NUMBER,
            "gain": _ONE_OR_THREE,
            "offset": _ONE_OR_THREE,
            "matrix": _Kind("three rows of three numbers", _rows(3, 3)),
        },
    ),
    "retime": _Action("retime", takes={"shift": _NUMBER, "stretch": _NUMBER, "about": _NUMBER, "outside": _TEXT}),
    "freeze": _Action("freeze", {"at": _NUMBER}),
    "to_front": _Action("to_front", spans=False),
    "to_back": _Action("to_back", spans=False),
    "place": _Action("place", takes={"depth": _NUMBER, "degrees": _THREE, "about": _PAIR}, named={"degrees": "rotate"}),
}


@dataclasses.dataclass(frozen=True)
class EditScript:
    """A script whose form is right: `apply` it to a video. Made by `read_edit_script` and `parse_edit_script`."""

    tables: dict[str, Any]
    source: str  # its name in errors
    text: str
    folder: Path  # that paths are relative to
    _within: tuple[Path, ...] = ()  # this file, and the scripts that it is read from

    def apply(self, video: Video) -> Video:
        """The edited video: a plain `VideoModel` where all edits could be baked; of a clip in segments one in segments.

        **Raises:** `EditScriptError`, with the line, for values that the edits refuse and files that cannot be read.
        """
        edits, named = edit(video), {}
        for name, table in self.tables.get("selections", {}).items():
            with self._at("selections", name, path="file" if "file" in table else "mask"):
                named[name] = self._selected(video, table, named)
        for number, table in enumerate(self.tables.get("edits", ())):
            action = ACTIONS[table["do"]]
            place = self._at("edits", number, **{own: key for key, own in action.named.items()})
            with place:
                if isinstance(edits, SegmentedEdit):
                    edits = edits.with_error_context(place)  # of what only the models tell, later
                edits = self._edited(edits, action, table, named)
        video = self._stacked(edits.video())
        if "camera" in self.tables:
            with self._at("camera"):
                angles = (math.radians(self.tables["camera"].get(key, 0.0)) for key in ("azimuth", "elevation"))
                video = edit(video).seen_from(Camera.front(video.size[0] / video.size[1]).orbit(*angles)).video()
        return video

    def _selected(self, video: Video, table: dict[str, Any], named: dict[str, Selected]) -> Selected:
        if table.keys() & _COMBINED.keys():
            return _combined(table, named)
        criteria = _with_pairs(table)
        if "file" in criteria:
            if not isinstance(video, VideoModel):
                got = "one in segments" if isinstance(video, SegmentedVideo) else "an edited video"
                raise invalid("file", expected="a model without layers or overlays", got=got)
            found = load_selection(self._path(criteria.pop("file")), video)
            return found & edit(video).select(**criteria).selection if criteria else found
        if "mask" in criteria:
            options = {key: criteria.pop(key) for key in _MASK_FILE.keys() & criteria.keys()}
            masks = read_masks(self._path(criteria["mask"]), **options, size=video.size)
            criteria["mask"] = _of_frames(masks, video.num_frames, criteria)
        return edit(video).select(**criteria).selection

    def _edited(self, edits: Chain, action: _Action, table: dict[str, Any], named: dict[str, Selected]) -> Chain:
        if "select" in table:
            edits = edits.select_begun(named[table["select"]])
            if not len(edits.selection):
                got = f"{table['select']!r}, which found nothing, or what has vanished"
                raise invalid("select", expected="a selection of at least one Gaussian", got=got)
        given = {key: value for key, value in _with_pairs(table).items() if key not in ("do", "select")}
        return action.apply(edits, given)

    def _stacked(self, video: Video) -> Video:
        front, behind = [], []
        for number, table in enumerate(self.tables.get("layers", ())):
            with self._at("layers", number, path="model", frame="freeze"):
                side = front if table.get("where", "behind") == "front" else behind
                side.append(self._layer(table))
        if not (front or behind):
            return video
        with self._at("layers", 0):
            return layers(*front, video, *behind, timeline=len(front))

    def _layer(self, table: dict[str, Any]) -> Video:
        other: Video = load_video_model(self._path(table["model"]))
        if "script" in table:
            path = self._path(table["script"])
            if path.resolve() in self._within:
                raise invalid(
                    "script", expected="a script that does not come back to itself", got=repr(table["script"])
                )
            script = read_edit_script(path)
            other = dataclasses.replace(script, _within=script._within + self._within).apply(other)
        return edit(other).freeze(table["freeze"]).video() if "freeze" in table else other

    def _path(self, given: str) -> Path:
        return self.folder / os.path.expanduser(given)

    def _at(self, *table: str | int, **named: str) -> "_Place":
        return _Place(self.source, self.text, table, named)


def read_edit_script(path: str | os.PathLike) -> EditScript:
    """Read a script and check its form: tables, keys, names, kinds of values. `EditScript.apply` checks the values.

    **Raises:** `FileNotFoundError`; `EditScriptError` with line and key for everything else.

    **Example:** `read_edit_script("edits.toml").apply(load_video_model("clip.safetensors"))`.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise FileNotFoundError(f"script: expected a TOML file, got {str(path)!r}, which is missing.")
    if not path.is_file():
        raise EditScriptError(f"{path}: expected a TOML file, got a folder or a device.")
    if path.stat().st_size > MAX_BYTES:
        got = f"{path.stat().st_size:,}"
        raise EditScriptError(f"{path}: expected a text of at most {MAX_BYTES:,} bytes, got {got}. Is it a model?")
    try:
        text = path.read_bytes().decode("utf-8-sig")  # some editors of Windows begin with a mark
    except UnicodeDecodeError as error:
        raise EditScriptError(
            f"{path}: expected a text in UTF-8, got other bytes at {error.start}. Is it a model?"
        ) from error
    except OSError as error:
        raise EditScriptError(f"{path}: expected a file that can be read, got {error}.") from error
    script = parse_edit_script(text, source=str(path), folder=path.parent)
    return dataclasses.replace(script, _within=(path.resolve(),))


def parse_edit_script(text: str, *, source: str = "script", folder: str | os.PathLike = ".") -> EditScript:
    """As `read_edit_script`, of a text; paths in it are relative to `folder`."""
    if _DEEP_KEY.search(text):
        raise EditScriptError(f"{source}: expected keys of a few parts, got one of more than {MAX_PARTS}.")
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise _no_toml(source, text, error) from error
    _check_names(_Place(source, text, ()), tables, _TABLES)
    selections = tables.get("selections", {})
    _check_selections(source, text, selections)
    for name, check in (("edits", _check_edit), ("layers", _check_layer)):
        rows = tables.get(name, [])
        if not (isinstance(rows, list) and all(isinstance(row, dict) for row in rows)):
            raise _Place(source, text, ()).error(name, f"tables, each begun by [[{name}]]", "something else")
        for number, row in enumerate(rows):
            check(_Place(source, text, (name, number)), row, selections)
    if not isinstance(tables.get("camera", {}), dict):
        raise _Place(source, text, ()).error("camera", "a table begun by [camera]", "something else")
    _check_keys(_Place(source, text, ("camera",)), tables.get("camera", {}), _CAMERA)
    return EditScript(tables, source, text, Path(folder))


def _no_toml(source: str, text: str, error: Exception) -> EditScriptError:
    """Of `tomllib`'s own words, with the line where the others have it."""
    told = " ".join(str(error).split()) or "endless nesting"
    place = re.search(r" \(at line (\d+), (column \d+)\)$", told)
    if place:
        return EditScriptError(f"{source}, line {place[1]}: expected TOML, got: {told[: place.start()]}, {place[2]}.")
    end = re.search(r" \(at end of document\)$", told)
    if end:
        line = text.count("\n") + 1
        return EditScriptError(f"{source}, line {line}: expected TOML, got: {told[: end.start()]}, the text's end.")
    return EditScriptError(f"{source}: expected TOML, got: {told}.")


@dataclasses.dataclass(frozen=True)
class _Place:
    """A table of the script; as a context, it puts file, line, table and key before an error from inside.

    `named`: keys of the script, by what the code inside calls them.
    """

    source: str
    text: str
    table: tuple[str | int, ...]
    named: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def error(self, key: str | None, expected: str, got: object, cure: str = "") -> EditScriptError:
        return self._told(key, str(invalid(key or "table", expected=expected, got=got, cure=cure)))

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind, error, trace) -> None:
        if isinstance(error, EditScriptError) or not isinstance(error, ValueError | TypeError | OSError):
            return
        parameters, colon, rest = " ".join(str(error).split()).partition(":")
        if not re.fullmatch(r"[a-z_]+(, [a-z_]+)*", parameters):
            raise self._told(None, parameters + colon + rest) from error
        keys = [self.named.get(name, name) for name in parameters.split(", ")]
        known = next((key for key in keys if self._line(key) is not None), None)
        raise self._told(known, f"{', '.join(keys)}{colon}{rest}") from error

    def _told(self, key: str | None, text: str) -> EditScriptError:
        line = self._line(key) or self._line(None)
        where = f"{self.source}, line {line}" if line else self.source
        return EditScriptError(f"{where}{self._name()}: {text}")

    def _name(self) -> str:
        match self.table:
            case (str(name), int(number)):
                return f", [[{name}]] number {number + 1}"
            case ():
                return ""
        return f", [{'.'.join(map(str, self.table))}]"

    def _line(self, key: str | None) -> int | None:
        """The line of a key of the table, or of the table's own beginning; None where the text has no such key."""
        try:
            return key_lines(self.text).get(self.table if key is None else (*self.table, key))
        except RecursionError:  # values nested as deep as `tomllib` just bears
            return None


def _check_keys(place: _Place, table: dict[str, Any], known: _Keys, needed: _Keys | None = None) -> None:
    """No other keys, those needed, and values of their kinds."""
    _check_names(place, table, known)
    missing = [key for key in needed or {} if key not in table]
    if missing:
        raise place.error(None, f"the key {missing[0]!r}", ", ".join(sorted(table)) or "an empty table")
    for key, value in table.items():
        if not known[key].holds(value):
            raise place.error(key, known[key].expected, _shown(value))


def _check_names(place: _Place, table: dict[str, Any], known: Mapping[str, Any] | tuple[str, ...]) -> None:
    for key in table:
        if key not in known:
            raise place.error(key, "one of " + ", ".join(sorted(known)), repr(key), _near(key, known))


def _near(word: str, known: Mapping[str, Any] | tuple[str, ...]) -> str:
    near = difflib.get_close_matches(word, known, 1)
    return f"Did you mean {near[0]!r}?" if near else ""


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # of thousands of digits, or as deep as can be
        return "something else"
    return text if len(text) <= 60 else text[:57] + "..."


def _check_selections(source: str, text: str, selections: Any) -> None:
    if not (isinstance(selections, dict) and all(isinstance(table, dict) for table in selections.values())):
        expected = "tables, each begun by [selections.NAME]"
        raise _Place(source, text, ()).error("selections", expected, "something else")
    known: dict[str, None] = {}
    for name, table in selections.items():
        place = _Place(source, text, ("selections", name))
        if not table:
            raise place.error(None, "at least one criterion", "none")
        if table.keys() & _COMBINED.keys():
            _check_keys(place, table, _COMBINED)
            _check_combined(place, table, known)
        else:
            _check_keys(place, table, {**_CRITERIA, **(_MASK_FILE if "mask" in table else {})})
            if "mask" in table and "file" in table:
                raise place.error("file", "a mask or a file", "both", "Combine two selections with all=[...].")
        known[name] = None


def _check_combined(place: _Place, table: dict[str, list[str]], known: dict[str, None]) -> None:
    for key, names in table.items():
        for name in names:
            if name not in known:
                expected = "a selection from before: " + (", ".join(known) or "there is none")
                raise place.error(key, expected, repr(name), _near(name, tuple(known)))


def _check_edit(place: _Place, table: dict[str, Any], selections: dict[str, Any]) -> None:
    do = table.get("do")
    if not isinstance(do, str) or do not in ACTIONS:
        got = "none" if do is None else _shown(do)
        raise place.error("do", "one of " + ", ".join(ACTIONS), got, _near(do, ACTIONS) if isinstance(do, str) else "")
    action = ACTIONS[do]
    _check_keys(place, table, {"do": _TEXT, "select": _TEXT, **action.keys}, action.needs)
    name = table.get("select")
    if name is not None and name not in selections:
        expected = "the name of a selection: " + (", ".join(selections) or "there is none")
        raise place.error("select", expected, repr(name), _near(name, selections))


def _check_layer(place: _Place, table: dict[str, Any], selections: dict[str, Any]) -> None:
    _check_keys(place, table, _LAYER, {"model": _PATH})
    if table.get("where", "behind") not in ("front", "behind"):
        raise place.error("where", "'front' or 'behind'", repr(table["where"]))


def _combined(table: dict[str, Any], named: dict[str, Selected]) -> Selected:
    some = [reduce(operator.or_, (named[name] for name in table["any"]))] if "any" in table else []
    every = [named[name] for name in table.get("all", ())]
    any_one = next(iter(named.values()))
    found = reduce(operator.and_, some + every or [any_one | ~any_one])
    return reduce(operator.sub, (named[name] for name in table.get("without", ())), found)


def _of_frames(masks, num_frames: int, criteria: dict[str, Any]):
    """Of masks for the whole clip, those of the frames that are looked at."""
    if masks.ndim == 2 or len(masks) != num_frames:
        return masks
    frame, frames = criteria.get("frame"), criteria.get("frames")
    return masks[slice(*frames)] if frames is not None else masks if frame is None else masks[frame : frame + 1]


def _with_pairs(table: dict[str, Any]) -> dict[str, Any]:
    """What stands for spans, lists or "A:B", as tuples."""
    spans = {key: _pair(table[key]) for key in ("frames", "times") if key in table}
    return table | spans


def _pair(value: list[float] | str) -> tuple[float | None, ...]:
    ends = value.split(":") if isinstance(value, str) else value
    return tuple((int(end) if end else None) if isinstance(end, str) else end for end in ends)


def _radians(degrees: float | list[float]) -> float | list[float]:
    """Of one number or a list of them."""
    return [math.radians(one) for one in degrees] if isinstance(degrees, list) else math.radians(degrees)
