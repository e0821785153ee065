"""Edit scripts: TOML files that select and change objects of a video. Errors name the table and the key.

The schema, in which every table is optional; paths are relative to the script, angles are in degrees, and all other
values are in the units of `Edit`:

- `[selections.NAME]`: `indices` (numbers and ranges of Gaussians, "3,17,40-52", with `num_gaussians`, which is
  checked, and, of a video in segments, the number of a `segment`), `mask` (an image, folder or video, with `label`,
  `level`), `layer` (a number or a name), or `box`, `polygon`, `color`, `click`, `moving`, `times`, with `frame`,
  `frames`, `tolerance`, `alive`, `threshold`, `follow`, as `foldgauss.video.select` takes them; or `any`, `all`,
  `without`: lists of earlier names, for the union, the intersection and the difference. All are evaluated on the video
  before the first edit.
- `[[edits]]`, applied in order: `do` is one of `ACTIONS`, `select` a name (default: the current selection, at first
  everything), with the action's own keys; `frame`, `frames` or `times`, with `ease` and `curve`, for the span.
- `frames` is `[first, stop]`, or "first:stop" where either may be left out: "10:" is open at the end.
- `[[layers]]`: other videos, `model` and `where` ("front" or "behind"), with `freeze` (a frame) or a `script` of
  their own; those behind are listed from front to back.
- `[camera]`: `azimuth` and `elevation`, relative to the front; it sees all layers.
"""

import dataclasses
import difflib
import functools
import inspect
import math
import operator
import os
import re
import tomllib
from collections import deque
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from foldgauss._runtime.checks import ParameterError, invalid, require, short_repr
from foldgauss.io._atomic import MissingInput, PathLike, describe_missing, resolve
from foldgauss.io.media.masks import read_masks
from foldgauss.io.models.selections import parse_indices, parse_ranges
from foldgauss.io.models.video_model import load_video_model, read_origin
from foldgauss.render import Camera
from foldgauss.video.editing.chain import Edit, edit
from foldgauss.video.editing.edited_video import EditedVideo
from foldgauss.video.editing.timing import When
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.segmented.layering import layers
from foldgauss.video.segmented.segmented_edit import SegmentedEdit
from foldgauss.video.segmented.segmented_video import SegmentedVideo
from foldgauss.video.selection.selectors import Selection, select

Video = VideoModel | EditedVideo | SegmentedVideo
Chain = Edit | SegmentedEdit

#: Size of the largest script that is read: some hundred selections of scattered Gaussians by their indices.
MAX_BYTES = 32_000_000
#: Largest number of parts of a dotted key; the parser makes a table for each.
MAX_PARTS = 16
_DEEP_KEY = re.compile(rf"(?<![\w\"'-])(?:[\w\"'-]+[ \t]*\.[ \t]*){{{MAX_PARTS}}}")
#: Largest absolute value of a number; no position, time or angle is larger, and squares could overflow.
LARGEST = 1e9


class EditScriptError(ValueError):
    """An invalid script; the message is one line with file, table, key, expected and got."""


@dataclasses.dataclass(frozen=True)
class _Kind:
    """The values that a key accepts, with their description in error messages."""

    expected: str
    holds: Callable[[Any], bool]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST  # so no NaN


def _is_whole(value: Any) -> bool:
    return _is_number(value) and isinstance(value, int) and value >= 0


def _are_numbers(value: Any) -> bool:
    return all(map(_are_numbers, value)) if isinstance(value, list) else _is_number(value)


def _are_tables(values: Any) -> bool:
    return all(isinstance(value, dict) for value in values)


def _are_frames(value: Any) -> bool:
    """Whether it is [first, stop], or "A:B", as in the commands, where either may be left out."""
    if isinstance(value, str):
        return re.fullmatch("[0-9]{0,9}:[0-9]{0,9}", value) is not None
    return isinstance(value, list) and len(value) == 2 and all(map(_is_whole, value))


_NUMBERS = _Kind("a number, or an array of numbers as the edit takes them", _are_numbers)
_WHOLE = _Kind("a whole number >= 0", _is_whole)
_BOOL = _Kind("true or false", lambda value: isinstance(value, bool))
_TEXT = _Kind("a text in quotes", lambda value: isinstance(value, str) and bool(value))
_PATH = _Kind("a path in quotes", lambda value: isinstance(value, str) and bool(value) and "\0" not in value)
_NAMES = _Kind(
    'a list of names of selections, as ["one", "other"]',
    lambda value: isinstance(value, list) and bool(value) and all(map(_TEXT.holds, value)),
)
_FRAMES = _Kind(
    'two whole numbers, as [10, 20]: first, and the first beyond; or "10:", from there to the end', _are_frames
)
#: The values of keys; all others are numbers, whose shape and range the edits check.
_KINDS = {
    "selections": _Kind(
        "tables, each begun by [selections.NAME]",
        lambda value: isinstance(value, dict) and _are_tables(value.values()),
    ),
    "edits": _Kind("tables, each begun by [[edits]]", lambda value: isinstance(value, list) and _are_tables(value)),
    "layers": _Kind("tables, each begun by [[layers]]", lambda value: isinstance(value, list) and _are_tables(value)),
    "camera": _Kind("a table begun by [camera]", lambda value: isinstance(value, dict)),
    "layer": _Kind("the number or the name of a layer", lambda value: _is_whole(value) or _TEXT.holds(value)),
    "moving": _Kind("true", lambda value: value is True),
    "where": _Kind("'front' or 'behind'", lambda value: value in ("front", "behind")),
    "frames": _FRAMES,
    **dict.fromkeys(("any", "all", "without"), _NAMES),
    **dict.fromkeys(("mask", "model", "script"), _PATH),
    **dict.fromkeys(("frame", "label", "num_gaussians", "segment"), _WHOLE),
    **dict.fromkeys(("alive", "follow", "originals"), _BOOL),
    **dict.fromkeys(("do", "select", "curve", "indices"), _TEXT),
}
_COMBINATION = ("any", "all", "without")
_MASK_FILE = ("label", "level")
_CRITERIA = ("layer", *tuple(inspect.signature(select).parameters)[1:])


@dataclasses.dataclass(frozen=True)
class _Action:
    """A value of `do`, a method of `Edit`: its keys are the parameters, but an angle is called "degrees"."""

    keys: tuple[str, ...]
    required: tuple[str, ...]
    angle: str  # the parameter that "degrees", converted to radians, are given to
    spans: bool

    @classmethod
    def of(cls, method: Callable[..., Edit]) -> "_Action":
        parameters = dict(inspect.signature(method).parameters)
        del parameters["self"]
        spans = parameters.pop("when", None) is not None
        angle = next((name for name in ("angle", "rotate") if name in parameters), "")
        keys = {"degrees" if name == angle else name: own.default for name, own in parameters.items()}
        keys.pop("clock", None)  # which no text describes
        required = tuple(name for name, default in keys.items() if default is inspect.Parameter.empty)
        return cls((*keys, *(When.__annotations__ if spans else ())), required, angle, spans)


_ACTION_NAMES = (
    *("move", "scale", "rotate", "transform", "multiply", "vanish", "opacity", "recolor", "retime", "freeze"),
    *("to_front", "to_back", "place"),
)
#: The actions of edits, each a method of `foldgauss.video.Edit`.
ACTIONS = {name: _Action.of(getattr(Edit, name)) for name in _ACTION_NAMES}


@dataclasses.dataclass(frozen=True)
class EditScript:
    """A parsed script, to be applied to a video by `apply`. Made by `read_edit_script` and `parse_edit_script`."""

    tables: dict[str, Any]
    source: str  # the script's name in errors
    folder: Path  # paths are relative to it
    _includes: tuple[Path, ...] = ()  # the path of this script and of those that include it

    @property
    def inputs(self) -> list[Path]:
        """The files and folders that the script names: masks, selections, models and scripts."""
        tables = [*self.tables.get("selections", {}).values(), *self.tables.get("layers", ())]
        return [self._path(table[key]) for table in tables for key in ("mask", "model", "script") if key in table]

    def apply(self, video: Video, origin: Mapping[str, Any] = MappingProxyType({})) -> Video:
        """The edited video: a plain `VideoModel` if all edits could be baked; segmented if `video` is.

        `origin`: the metadata of its file, as `read_metadata` returns them: `frames`, the range of its clip that the
        video shows, to which masks of the whole clip are cut.

        **Raises:** `EditScriptError` for values that the edits refuse and files that cannot be read.
        """
        edits, named = edit(video), {}
        for name, table in self.tables.get("selections", {}).items():
            with self._context("selections", name, path="mask"):
                named[name] = self._select(video, table, named, origin)
        for number, table in enumerate(self.tables.get("edits", ())):
            context = self._context("edits", number, **{ACTIONS[table["do"]].angle: "degrees"})
            with context:
                if isinstance(edits, SegmentedEdit):
                    edits = edits.with_error_context(context)  # for errors that occur when models are loaded
                edits = self._apply_edit(edits, table, named)
        video = self._add_layers(edits.video())
        if "camera" in self.tables:
            with self._context("camera"):
                angles = (math.radians(self.tables["camera"].get(key, 0.0)) for key in ("azimuth", "elevation"))
                video = edit(video).seen_from(Camera.front(video.size[0] / video.size[1]).orbit(*angles)).video()
        return video

    def _select(
        self, video: Video, table: dict[str, Any], named: dict[str, Selection], origin: Mapping[str, Any]
    ) -> Selection:
        if table.keys() & set(_COMBINATION):
            return _combine(table, named)
        if "indices" in table:
            return _select_indices(video, **table)
        criteria = _convert_frames(table)
        if "mask" in criteria:
            options = {key: criteria.pop(key) for key in criteria.keys() & set(_MASK_FILE)}
            masks, frames = read_masks(self._path(criteria["mask"]), size=video.size, **options), origin.get("frames")
            if masks.ndim == 3 and frames is not None and len(masks) != video.num_frames:
                shown = masks[slice(*frames)]  # of masks of the whole clip
                masks = shown if len(shown) == video.num_frames else masks
            criteria["mask"] = _masks_of_frames(masks, video.num_frames, criteria)
        return edit(video).select(**criteria).selection

    def _apply_edit(self, edits: Chain, table: dict[str, Any], named: dict[str, Selection]) -> Chain:
        if "select" in table:
            edits = edits.select(named[table["select"]])
            require(
                len(edits.selection),
                "select",
                expected="a selection of at least one Gaussian",
                got=f"{table['select']!r}, which found nothing, or only deleted Gaussians",
            )
        given = {key: value for key, value in _convert_frames(table).items() if key not in ("do", "select")}
        if "degrees" in given:
            given[ACTIONS[table["do"]].angle] = np.radians(given.pop("degrees")).tolist()
        return getattr(edits, table["do"])(**given)

    def _add_layers(self, video: Video) -> Video:
        front, behind = [], []
        for number, table in enumerate(self.tables.get("layers", ())):
            with self._context("layers", number, path="model", frame="freeze"):
                side = front if table.get("where", "behind") == "front" else behind
                side.append(self._load_layer(table))
        if not (front or behind):
            return video
        with self._context("layers", 0):
            return layers(*front, video, *behind, timeline=len(front))

    def _load_layer(self, table: dict[str, Any]) -> Video:
        other: Video = load_video_model(file := self._path(table["model"]))
        if "script" in table:
            path = self._path(table["script"])
            require(
                resolve(path) not in self._includes,
                "script",
                expected="a script that does not include itself",
                got=repr(table["script"]),
            )
            script = read_edit_script(path)
            script = dataclasses.replace(script, _includes=script._includes + self._includes)
            other = script.apply(other, read_origin(file))
        return edit(other).freeze(table["freeze"]).video() if "freeze" in table else other

    def _path(self, given: str) -> Path:
        return self.folder / os.path.expanduser(given)

    def _context(self, *table: str | int, **named: str) -> "_TableContext":
        return _TableContext(self.source, table, named)


def read_edit_script(path: PathLike) -> EditScript:
    """Read a script and check tables, keys, names and types of values. `EditScript.apply` checks the values.

    **Raises:** `FileNotFoundError`; `EditScriptError` with table and key for all other errors.

    **Example:** `read_edit_script("edits.toml").apply(load_video_model("clip.safetensors"))`.
    """
    path = Path(path)
    require(
        os.path.exists(path),
        "script",
        expected="a TOML file",
        got=f"{str(path)!r}, {describe_missing(path)}",
        kind=MissingInput,
    )
    if not path.is_file():
        raise EditScriptError(f"{path}: expected a TOML file, got a folder or a device.")
    if path.stat().st_size > MAX_BYTES:
        got = f"{path.stat().st_size:,}"
        raise EditScriptError(f"{path}: expected a script of at most {MAX_BYTES:,} bytes, got {got}. Is it a model?")
    try:
        text = path.read_bytes().decode("utf-8-sig")  # some editors of Windows write a byte order mark
    except UnicodeDecodeError as error:
        got = f"other bytes at {error.start}"
        raise EditScriptError(f"{path}: expected a text in UTF-8, got {got}. Is it a model?") from error
    except OSError as error:
        raise EditScriptError(f"{path}: expected a file that can be read, got {error}.") from error
    script = parse_edit_script(text, source=str(path), folder=path.parent)
    return dataclasses.replace(script, _includes=(resolve(path),))


def parse_edit_script(text: str, *, source: str = "script", folder: PathLike = ".") -> EditScript:
    """As `read_edit_script`, for the text of a script; paths in it are relative to `folder`."""
    if _DEEP_KEY.search(text):
        raise EditScriptError(f"{source}: expected keys of a few parts, got one of more than {MAX_PARTS}.")
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        message = " ".join(str(error).split()) or "endless nesting"
        raise EditScriptError(f"{source}: expected TOML, got: {message}.") from error
    script = EditScript(tables, source, Path(folder))
    with script._context():
        _check_keys(tables, ("selections", "edits", "layers", "camera"))
    known: dict[str, None] = {}
    for name, table in tables.get("selections", {}).items():
        with script._context("selections", name):
            _check_selection(table, known)
        known[name] = None
    for number, table in enumerate(tables.get("edits", ())):
        with script._context("edits", number):
            _check_edit(table, known)
    for number, table in enumerate(tables.get("layers", ())):
        with script._context("layers", number):
            _check_keys(table, ("model", "where", "freeze", "script"), ("model",))
    with script._context("camera"):
        _check_keys(tables.get("camera", {}), ("azimuth", "elevation"))
    return script


@dataclasses.dataclass(frozen=True)
class _TableContext:
    """A table of the script; as a context manager it adds file, table and key to errors raised inside.

    `named`: the script's keys by the parameter names that errors mention.
    """

    source: str
    table: tuple[str | int, ...]
    named: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind, error, trace) -> None:
        if isinstance(error, EditScriptError) or not isinstance(error, ValueError | TypeError | OSError):
            return
        text = str(error)
        if isinstance(error, ParameterError):
            keys = [self.named.get(name, name) for name in error.parameter.split(", ")]
            text = f"{', '.join(keys)}: {error.problem}"
        raise EditScriptError(f"{self.source}{self._name()}: {' '.join(text.split())}") from error

    def _name(self) -> str:
        match self.table:
            case (str(name), int(number)):
                return f", [[{name}]] number {number + 1}"
            case ():
                return ""
        return f", [{'.'.join(map(str, self.table))}]"


def _check_keys(table: dict[str, Any], known: Collection[str], needed: Collection[str] = ()) -> None:
    """Raise for unknown keys, missing required keys, and values of a wrong type."""
    for key in table:
        _check_known(key, "one of ", key, sorted(known))
    for key in needed:
        require(key in table, "table", expected=f"the key {key!r}", got=", ".join(sorted(table)) or "an empty table")
    for key, value in table.items():
        kind = _KINDS.get(key, _NUMBERS)
        require(kind.holds(value), key, expected=kind.expected, got=_describe(value))


def _check_known(key: str, expected: str, word: str, known: Collection[str]) -> None:
    """Raise unless a word is known; `expected` says what it is one of."""
    near = [] if word in known else difflib.get_close_matches(word, known, 1)
    require(
        word in known,
        key,
        expected=expected + (", ".join(known) or "there is none"),
        got=short_repr(word),
        cure=f"Did you mean {near[0]!r}?" if near else "",
    )


def _describe(value: Any) -> str:
    """`short_repr`, also of what Python does not write: numbers of thousands of digits, and deep nesting."""
    try:
        return short_repr(value)
    except (ValueError, RecursionError):
        return "something else"


def _check_selection(table: dict[str, Any], known: Collection[str]) -> None:
    """Check a selection after those that are `known`."""
    require(table, "table", expected="at least one criterion", got="none")
    if table.keys() & set(_COMBINATION):
        _check_keys(table, _COMBINATION)
        for key, names in table.items():
            for name in names:
                _check_known(key, "a selection from before: ", name, known)
    elif "indices" in table:
        _check_keys(table, ("indices", "num_gaussians", "segment"))
        deque(parse_ranges(table["indices"]), maxlen=0)
    else:
        _check_keys(table, _CRITERIA + (_MASK_FILE if "mask" in table else ()))


def _check_edit(table: dict[str, Any], selections: Collection[str]) -> None:
    do = table.get("do")
    got = "none" if do is None else _describe(do)
    require(isinstance(do, str), "do", expected="one of " + ", ".join(ACTIONS), got=got)
    _check_known("do", "one of ", do, ACTIONS)
    _check_keys(table, ("do", "select", *ACTIONS[do].keys), ACTIONS[do].required)
    if "select" in table:
        _check_known("select", "the name of a selection: ", table["select"], selections)


def _select_indices(
    video: Video, indices: str, num_gaussians: int | None = None, segment: int | None = None
) -> Selection:
    """Gaussians by their indices in the video's order, of layers the front one's first; or in that of a segment."""
    if isinstance(video, SegmentedVideo):
        counts = [one.num_gaussians for one in video.segments]
        require(
            segment is not None and segment < len(counts),
            "segment",
            expected=f"the number of one of {len(counts)} segments",
            got="none" if segment is None else segment,
        )
    elif segment is not None:
        raise invalid("segment", expected="none, since the video has no segments", got=segment)
    else:
        counts, segment = [video.num_gaussians], 0
    require(
        num_gaussians in (None, counts[segment]),
        "num_gaussians",
        expected=f"{counts[segment]}, as many as there are",
        got=num_gaussians,
        cure="Give the model that the selection was made in, unchanged.",
    )
    parts = [Selection(np.zeros(num, bool)) for num in counts]
    parts[segment] = parse_indices(indices, counts[segment])
    return Selection(np.concatenate([part.mask for part in parts]))


def _combine(table: dict[str, Any], named: dict[str, Selection]) -> Selection:
    some = [functools.reduce(operator.or_, (named[name] for name in table["any"]))] if "any" in table else []
    every = [named[name] for name in table.get("all", ())]
    any_one = next(iter(named.values()))
    found = functools.reduce(operator.and_, some + every or [any_one | ~any_one])
    return functools.reduce(operator.sub, (named[name] for name in table.get("without", ())), found)


def _masks_of_frames(masks, num_frames: int, criteria: dict[str, Any]):
    """The masks of the frames that the criteria name, from masks of the whole clip."""
    if masks.ndim == 2 or len(masks) != num_frames:
        return masks
    frame, frames = criteria.get("frame"), criteria.get("frames")
    return masks[slice(*frames)] if frames is not None else masks if frame is None else masks[frame : frame + 1]


def _convert_frames(table: dict[str, Any]) -> dict[str, Any]:
    """A copy of the table with frames "A:B" as a tuple."""
    frames = table.get("frames")
    ends = frames.split(":") if isinstance(frames, str) else ()
    return table | ({"frames": tuple(int(end) if end else None for end in ends)} if ends else {})
