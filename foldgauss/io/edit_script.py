"""Edits as a text: a TOML file that selects and changes objects of a video, checked with the line of each mistake.

Schema, every table optional; paths are relative to the script, angles in degrees, else the units of `Edit`:

- `[selections.NAME]`: `mask` (an image, folder or video, with `label`, `level`) or `file` (of `save_selection`), or
  `box`, `polygon`, `color`, `click`, `times`, with `frame`, `frames`, `tolerance`, `alive`, `threshold`, `follow`, as
  `foldgauss.video.select.select` takes them; or `any`, `all`, `without`: names given before, united, intersected, left
  out. All are found in the video as it was before the first edit.
- `[[edits]]`, in their order: `do` is one of `ACTIONS`, `select` a name (without: what is selected as it stands, at
  first everything), and the action's own keys; `frame`, `frames` or `times` with `ease` and `curve` for when.
- `[[layers]]`: other videos, `model` and `where` ("front" or "behind"), with `freeze` (a frame) or a `script` of
  their own; those behind from front to back.
- `[camera]`: `azimuth` and `elevation`, from the front.
"""

import dataclasses
import difflib
import math
import os
import re
import tomllib
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

from foldgauss._checks import invalid
from foldgauss.io.masks import read_masks
from foldgauss.io.selections import load_selection
from foldgauss.io.video_model import load_video_model
from foldgauss.render import Camera
from foldgauss.video.edit import Edit, edit
from foldgauss.video.edited import EditedVideo, layers
from foldgauss.video.model import VideoModel
from foldgauss.video.select import Selection

Video = VideoModel | EditedVideo

_WHEN = frozenset({"frame", "frames", "times", "ease", "curve"})
_COMBINED = frozenset({"any", "all", "without"})
_MASK_FILE = frozenset({"label", "level"})
_CRITERIA = frozenset(
    {"mask", "file", "box", "polygon", "color", "click", "times", "frame", "frames", "tolerance", "alive"}
    | {"threshold", "follow"}
)
_LAYER = frozenset({"model", "where", "freeze", "script"})
_CAMERA = frozenset({"azimuth", "elevation"})
_TABLES = frozenset({"selections", "edits", "layers", "camera"})
#: The largest script that is read: tens of thousands of edits.
MAX_BYTES = 4_000_000


class EditScriptError(ValueError):
    """A script that says what cannot be done; the message is one line: file, line, table, key, expected, got."""


@dataclasses.dataclass(frozen=True)
class _Action:
    """A word for `do`: the method, the keys it must and may have; those in degrees, by the name that it takes."""

    apply: Callable[..., Edit]
    needs: frozenset[str] = frozenset()
    takes: frozenset[str] = frozenset()
    spans: bool = True

    @property
    def keys(self) -> frozenset[str]:
        return self.needs | self.takes | (_WHEN if self.spans else frozenset())


def _action(method: str, needs: str = "", takes: str = "", *, spans: bool = True, **in_degrees: str) -> _Action:
    def apply(edit: Edit, **given: Any) -> Edit:
        for name, own in in_degrees.items():
            if name in given:
                given[own] = _radians(name, given.pop(name))
        return getattr(edit, method)(**given)

    return _Action(apply, frozenset(needs.split()), frozenset(takes.split()), spans)


#: What an edit can do, each a method of `foldgauss.video.Edit`.
ACTIONS = {
    "move": _action("move", "offset"),
    "scale": _action("scale", "factor", "about"),
    "rotate": _action("rotate", "degrees", "about", degrees="angle"),
    "transform": _action("transform", "matrix", "offset about"),
    "multiply": _action("multiply", "offsets", "delays scale degrees about originals", degrees="angle"),
    "vanish": _action("vanish"),
    "opacity": _action("opacity", "factor"),
    "recolor": _action("recolor", "", "color hue gain offset matrix"),
    "retime": _action("retime", "", "shift stretch about outside"),
    "freeze": _action("freeze", "at", spans=False),
    "place": _action("place", "", "depth degrees about", degrees="rotate"),
}


@dataclasses.dataclass(frozen=True)
class EditScript:
    """A script whose form is right: `apply` it to a video. Made by `read_edit_script` and `parse_edit_script`."""

    tables: dict[str, Any]
    source: str  # its name in errors
    text: str
    folder: Path  # that paths are relative to

    def apply(self, video: Video) -> Video:
        """The edited video: a plain `VideoModel` where all edits could be baked.

        **Raises:** `EditScriptError`, with the line, for values that the edits refuse and files that cannot be read.
        """
        edits, named = edit(video), {}
        for name, table in self.tables.get("selections", {}).items():
            with self._at("selections", name):
                named[name] = self._selected(video, table, named)
                edits = edits.select(named[name]).remember(name)
        edits = edits.select()
        for number, table in enumerate(self.tables.get("edits", ())):
            with self._at("edits", number):
                edits = _edited(edits, table)
        if "camera" in self.tables:
            with self._at("camera"):
                edits = edits.seen_from(_camera(self.tables["camera"], video.size))
        return self._stacked(edits.video())

    def _selected(self, video: Video, table: dict[str, Any], named: dict[str, Selection]) -> Selection:
        if table.keys() & _COMBINED:
            return _combined(table, named)
        criteria = _with_pairs(table)
        if "file" in criteria:
            if not isinstance(video, VideoModel):
                raise invalid("file", expected="a model without layers or overlays", got="an edited video")
            found = load_selection(self._path("file", criteria.pop("file")), video)
            return found & edit(video).select(**criteria).selection if criteria else found
        if "mask" in criteria:
            options = {key: criteria.pop(key) for key in _MASK_FILE & criteria.keys()}
            path = self._path("mask", criteria["mask"])
            criteria["mask"] = read_masks(path, **options, size=video.size)
        return edit(video).select(**criteria).selection

    def _stacked(self, video: Video) -> Video:
        front, behind = [], []
        for number, table in enumerate(self.tables.get("layers", ())):
            with self._at("layers", number):
                other: Video = load_video_model(self._path("model", table["model"]))
                if "script" in table:
                    other = read_edit_script(self._path("script", table["script"])).apply(other)
                if "freeze" in table:
                    other = edit(other).freeze(table["freeze"]).video()
                (front if table.get("where", "behind") == "front" else behind).append(other)
        if not (front or behind):
            return video
        with self._at("layers", 0):
            return layers(*front, video, *behind, timeline=len(front))

    def _path(self, key: str, given: Any) -> Path:
        if not isinstance(given, str) or not given:
            raise invalid(key, expected="a path in quotes", got=repr(given))
        return self.folder / os.path.expanduser(given)

    def _at(self, *place: str | int) -> "_Place":
        return _Place(self.source, self.text, place)


def read_edit_script(path: str | os.PathLike) -> EditScript:
    """Read a script and check its form: tables, keys, names. Its values are checked by `EditScript.apply`.

    **Raises:** `FileNotFoundError`; `EditScriptError` with line and key for everything else.

    **Example:** `read_edit_script("edits.toml").apply(load_video_model("clip.safetensors"))`.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"script: expected a TOML file, got {str(path)!r}, which is missing.")
    if not path.is_file() or path.stat().st_size > MAX_BYTES:
        raise EditScriptError(f"{path}: expected a text of at most {MAX_BYTES:,} bytes, got something else.")
    try:
        text = path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise EditScriptError(f"{path}: expected a text in UTF-8, got other bytes at {error.start}.") from error
    return parse_edit_script(text, source=str(path), folder=path.parent)


def parse_edit_script(text: str, *, source: str = "script", folder: str | os.PathLike = ".") -> EditScript:
    """As `read_edit_script`, of a text; paths in it are relative to `folder`."""
    try:
        tables = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise EditScriptError(
            f"{source}: expected TOML, got {' '.join(str(error).split()) or 'endless nesting'}."
        ) from error
    _check_keys(_Place(source, text, ()), tables, _TABLES)
    _check_selections(source, text, tables.get("selections", {}))
    for name, check in (("edits", _check_edit), ("layers", _check_layer)):
        rows = tables.get(name, [])
        if not (isinstance(rows, list) and all(isinstance(row, dict) for row in rows)):
            raise _Place(source, text, ()).error(name, f"tables, each begun by [[{name}]]", "something else")
        for number, row in enumerate(rows):
            check(_Place(source, text, (name, number)), row, tables.get("selections", {}))
    camera, place = tables.get("camera", {}), _Place(source, text, ("camera",))
    if not isinstance(camera, dict):
        raise place.error("camera", "a table begun by [camera]", repr(camera))
    _check_keys(place, camera, _CAMERA)
    return EditScript(tables, source, text, Path(folder))


@dataclasses.dataclass(frozen=True)
class _Place:
    """A table of the script; as a context, it puts file, line, table and key before an error from inside."""

    source: str
    text: str
    table: tuple[str | int, ...]

    def error(self, key: str | None, expected: str, got: object, cure: str = "") -> EditScriptError:
        return self._told(key, str(invalid(key or "table", expected=expected, got=got, cure=cure)))

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind, error, trace) -> None:
        if isinstance(error, EditScriptError) or not isinstance(error, ValueError | TypeError | OSError):
            return
        text = " ".join(str(error).split())
        key = text.partition(":")[0]
        lines = {name: self._line(name) for name in re.findall(r"[a-z_]+", key)}
        known = next((name for name, line in lines.items() if line is not None), None)
        raise self._told(known, text) from error

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
        """The line of a key of the table, or of the table's own beginning; None where it is not found."""
        begun, count = not self.table, -1
        for number, line in enumerate(self.text.splitlines(), start=1):
            header = re.match(r"\s*(\[\[?)\s*([^\[\]]+?)\s*\]", line)
            if header:
                parts = [part.strip().strip("\"'") for part in header[2].split(".")]
                count += header[1] == "[[" and parts == [self.table[0]] if self.table else 0
                own = parts == list(self.table) or (parts == [*self.table][:1] and self.table[1:] == (count,))
                if not self.table and key is not None and parts[0] == key:
                    return number
                begun = own or (not self.table and number == 0)
                if own and key is None:
                    return number
            elif begun and key is not None and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*[=.]", line):
                return number
        return None


def _check_keys(
    place: _Place, table: dict[str, Any], known: frozenset[str], needed: frozenset[str] = frozenset()
) -> None:
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1)
            cure = f"Did you mean {near[0]!r}?" if near else ""
            raise place.error(key, "one of " + ", ".join(sorted(known)), repr(key), cure)
    missing = sorted(needed - table.keys())
    if missing:
        raise place.error(None, f"the key {missing[0]!r}", ", ".join(sorted(table)) or "an empty table")


def _check_selections(source: str, text: str, selections: Any) -> None:
    if not (isinstance(selections, dict) and all(isinstance(table, dict) for table in selections.values())):
        expected = "tables, each begun by [selections.NAME]"
        raise _Place(source, text, ()).error("selections", expected, "something else")
    known: list[str] = []
    for name, table in selections.items():
        place = _Place(source, text, ("selections", name))
        if not table:
            raise place.error(None, "at least one criterion", "none")
        if table.keys() & _COMBINED:
            _check_keys(place, table, _COMBINED)
            for key in table:
                _check_names(place, key, table[key], known)
        else:
            _check_keys(place, table, _CRITERIA | (_MASK_FILE if "mask" in table else frozenset()))
        known.append(name)


def _check_names(place: _Place, key: str, names: Any, known: list[str]) -> None:
    if not (isinstance(names, list) and names):
        raise place.error(key, "a list of names of selections", repr(names))
    for name in names:
        if name not in known:
            expected = "a selection from before: " + (", ".join(known) or "there is none")
            raise place.error(key, expected, repr(name))


def _check_edit(place: _Place, table: dict[str, Any], selections: dict[str, Any]) -> None:
    do = table.get("do")
    if not isinstance(do, str) or do not in ACTIONS:
        near = difflib.get_close_matches(str(do), ACTIONS, 1)
        cure = f"Did you mean {near[0]!r}?" if near else ""
        raise place.error("do", "one of " + ", ".join(ACTIONS), "none" if do is None else repr(do), cure)
    action = ACTIONS[do]
    _check_keys(place, table, action.keys | {"do", "select"}, action.needs)
    if "select" in table and table["select"] not in selections:
        expected = "the name of a selection: " + (", ".join(selections) or "there is none")
        raise place.error("select", expected, repr(table["select"]))


def _check_layer(place: _Place, table: dict[str, Any], selections: dict[str, Any]) -> None:
    _check_keys(place, table, _LAYER, frozenset({"model"}))
    if table.get("where", "behind") not in ("front", "behind"):
        raise place.error("where", "'front' or 'behind'", repr(table["where"]))


def _combined(table: dict[str, Any], named: dict[str, Selection]) -> Selection:
    some = [reduce(Selection.__or__, (named[name] for name in table["any"]))] if "any" in table else []
    every = [named[name] for name in table.get("all", ())]
    any_one = next(iter(named.values()))
    found = reduce(Selection.__and__, some + every or [any_one | ~any_one])
    return reduce(Selection.__sub__, (named[name] for name in table.get("without", ())), found)


def _with_pairs(table: dict[str, Any]) -> dict[str, Any]:
    """Lists that stand for spans as tuples."""
    spans = {key: tuple(table[key]) for key in ("frames", "times") if isinstance(table.get(key), list)}
    return table | spans


def _edited(edits: Edit, table: dict[str, Any]) -> Edit:
    given = {key: value for key, value in _with_pairs(table).items() if key not in ("do", "select")}
    if table["do"] == "freeze":
        given["frame"] = given.pop("at")
    if "select" in table:
        edits = edits.select(edits.remembered(table["select"]))
    return ACTIONS[table["do"]].apply(edits, **given)


def _camera(table: dict[str, Any], size: tuple[int, int]) -> Camera:
    azimuth, elevation = (_radians(key, table.get(key, 0.0)) for key in ("azimuth", "elevation"))
    return Camera.front(size[0] / size[1]).orbit(azimuth, elevation)


def _radians(key: str, degrees: Any) -> Any:
    """Of one number or a list of them."""
    if isinstance(degrees, list):
        return [_radians(key, one) for one in degrees]
    if isinstance(degrees, bool) or not isinstance(degrees, int | float) or not math.isfinite(degrees):
        raise invalid(key, expected="degrees, numbers", got=repr(degrees))
    return math.radians(degrees)
