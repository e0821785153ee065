"""A model as one HTML page with a player that renders the folded Gaussians at any time in a browser.

The page is self-contained: it holds the model as a compact file (one per segment) and makes no network requests. Only a
linked one reads the compact file beside it.
Its sources are the files in `player/`; `compact.js` decodes the models there. See docs/player.md.
"""

import base64
import dataclasses
import hashlib
import html
import json
import os
import re
import urllib.parse
import warnings
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from foldgauss._runtime.checks import is_integer, require, short_repr
from foldgauss.io._atomic import PathLike, atomic_path, check_path
from foldgauss.io.media.clip import Clip
from foldgauss.io.models.compact import COMPACT_SUFFIX, has_layers, is_compact, pack_compact
from foldgauss.io.models.selections import format_indices
from foldgauss.io.models.video_model import keep_origin, load_video_model, read_frame_seconds, read_origin
from foldgauss.video.compression.quantize import (
    COLORS,
    MAX_PATH_BITS,
    Quantized,
    Rule,
    column_names,
    compute_columns,
    is_integral,
    quantize,
)
from foldgauss.video.editing.edited_video import EditedVideo, as_edited
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.motion.moving_object import NothingMoves, nothing_moves
from foldgauss.video.segmented.layering import flatten_video
from foldgauss.video.segmented.segmented_video import SegmentedVideo
from foldgauss.video.selection.selectors import Selection, by_motion

HTML_SUFFIX = ".html"
#: WebP quality of the original's frames.
QUALITY = 80
#: Bytes above which browsers open a page slowly.
LARGE = 50e6
#: Bytes above which notebooks do not show a page automatically.
LARGEST_IN_NOTEBOOK = 20e6
#: The name of the object that moves, on its button.
MOVING = "the moving object"
_SOURCES = Path(__file__).parent / "player"
_DECODER = Path(__file__).parent / "compact.js"
_IMPORT = re.compile(r'^import (?:(?P<names>\{[^}]*\})|(?P<text>\w+)) from "\./(?P<name>[\w.-]+)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?:async )?(?:const|class|function) (\w+)", re.MULTILINE)
#: Where a server puts the edit script into the page.
_SCRIPT_PLACE = "<!--edit script-->"
#: Binary logarithm of equal steps, where steps in proportion are beyond the format.
_EVEN = -18.0
#: How many bits more the maps of shared paths have than in a compressed file.
_MORE_PATH_BITS = 5
_PER_E = 1.4427  # log2 e: slopes are those of natural logarithms

Loaded = VideoModel | EditedVideo | SegmentedVideo
Model = Loaded | PathLike
Frames = Clip | UInt8[np.ndarray, "num_frames height width channels"]


def write_html(
    path: PathLike,
    model: Model,
    *,
    original: Frames | None = None,
    quality: int = QUALITY,
    title: str | None = None,
    linked: bool = False,
) -> Path:
    """Write the page of `html_page` to a file that ends in .html; what exists is replaced. Warns of one beyond 50 MB.

    `linked`: the page reads the model from a compact file in its folder, in parts, so that it must be served over HTTP.
    A compact model that is there already is that file. Any other is written to the page's name with .page.fgz.

    Raises as `html_page`, ValueError for another name, `OutputError` where it cannot be written.

    Example: `write_html("clip.html", model, original=clip.frames)`.
    """
    path = check_path(path, "path, model")
    require(
        path.suffix.lower() == HTML_SUFFIX,
        "path",
        expected=f"a name ending in {HTML_SUFFIX}",
        got=repr(str(path)),
    )
    file = linked_file(path, model) if linked else None
    title, name = path.stem if title is None else title, None if file is None else file.name
    page = html_page(model, original=original, quality=quality, title=title, linked=name)
    warn_of_size(page)
    if file is not None and not (isinstance(model, PathLike) and file.exists() and file.samefile(model)):
        loaded, _, metadata = _load(model)
        with atomic_path(file) as temporary:
            temporary.write_bytes(_pack(model, loaded, metadata))
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path


def linked_file(path: Path, model: Model) -> Path:
    """The compact file that a page with this path reads its model from."""
    if isinstance(model, PathLike) and _is_plain(model) and Path(model).parent.resolve() == path.parent.resolve():
        return Path(model)
    return path.with_name(f"{path.stem}.page{COMPACT_SUFFIX}")  # of no model that someone keeps


def warn_of_size(page: str) -> None:
    """Warn of a page that browsers open slowly."""
    if len(page) > LARGE:
        cure = "Compress the model, show a part, or leave the original out."
        warnings.warn(f"page: {len(page) / 1e6:.0f} MB, which browsers are slow to open. {cure}", stacklevel=3)


@dataclasses.dataclass(frozen=True)
class SaveTarget:
    """Where a page that a local server serves saves its edit: `PUT /script` with the token in a header.

    `name` is the script's file name, for display. The server puts the script itself in by `with_script`.
    """

    name: str
    token: str

    def blocks(self) -> Iterator[str]:
        about = json.dumps({"token": self.token, "script": self.name}).replace("<", "\\u003c")
        yield f'<script type="application/json" id="server">{about}</script>'
        yield _SCRIPT_PLACE


def with_script(page: bytes, script: bytes | None) -> bytes:
    """A page with a `SaveTarget`, with the edit script that it begins with, if there is one, and its version."""
    block = "" if script is None else _block("script", script, f' data-version="{script_version(script)}"')
    return page.replace(_SCRIPT_PLACE.encode(), block.encode(), 1)


def script_version(script: bytes | None) -> str:
    """What tells versions of an edit script apart: its SHA-256, or "none" where there is no script."""
    return "none" if script is None else hashlib.sha256(script).hexdigest()


def html_page(
    model: Model,
    *,
    original: Frames | None = None,
    quality: int = QUALITY,
    title: str | None = None,
    moving: bool = False,
    save_to: SaveTarget | None = None,
    linked: str | None = None,
) -> str:
    """The page as text.

    `model`: a model; or the path of a file with one, of which a compact one goes in as it is. Any other is quantized
    finely, and so is each segment of a video in segments: see docs/player.md for the accuracy.
    `original`: the clip's frames, of the model's number and size, shown beside it; as WebP of `quality`, 1 to 100.
    `moving`: find the object that moves, which takes about a second per frame; a button of the page selects it.
    `save_to`: of a page that a local server serves; it may then make requests to that server, and to nothing else.
    `linked`: the name of a compact file beside the page, with the model, which is then not in the page, and which the
    page may ask its own server for. Not for videos in segments.

    Raises ValueError for edits that no folded model holds, a degree above 15, in a segment, too,
    for frames that do not fit, and for `linked` segments; its subclass `NothingMoves`; errors of reading as
    `load_video_model`.

    Example: `html_page(model, title="holiday")`.
    """
    require(
        is_integer(quality, 1) and quality <= 100,
        "quality",
        expected="a whole number from 1 to 100",
        got=quality,
    )
    plain, name, metadata = _load(model)
    pictures = [] if original is None else list(_encode_original(original, plain, quality))
    models = _encode_model(model, plain, metadata) if linked is None else [_link(plain, linked)]
    objects = json.dumps(_find_objects(plain, moving)).replace("<", "\\u003c")
    blocks = [*models, f'<script type="application/json" id="objects">{objects}</script>', *pictures]
    return _assemble(blocks, name if title is None else title, save_to, connects=linked is not None)


def empty_page() -> str:
    """The page without a model: it opens model files from the computer that it is shown on."""
    return _assemble([], "foldgauss player")


def make_notebook_iframe(model: VideoModel | EditedVideo | SegmentedVideo) -> str | None:
    """The page as an iframe for notebooks; None where it is too large or the model cannot be shown."""
    if model.num_parameters > LARGEST_IN_NOTEBOOK:  # each takes more than a byte
        return None
    try:
        page = html_page(model)
    except (ValueError, OSError):  # the file of a video in segments may be gone
        return None
    if len(page) > LARGEST_IN_NOTEBOOK:
        return None
    height, width = model.size
    tall = min(max(round(720 * height / width), 240), 560) + 150
    shown = f'srcdoc="{html.escape(page)}" sandbox="allow-scripts allow-downloads" loading="lazy"'
    return f'<iframe {shown} width="100%" height="{tall}" frameborder="0" title="foldgauss player"></iframe>'


# ----------------------------------------------------------------------------------------------- the model


def _load(model: Model) -> tuple[Loaded, str, dict]:
    """The model, a name for it, and the metadata that the page needs."""
    if isinstance(model, PathLike):
        path = check_path(model, "model")
        about, loaded = read_origin(path), load_video_model(path)
        kept = keep_origin(about, "frames", "first_second")
        if read_frame_seconds(about, loaded.num_frames) is not None:
            kept |= keep_origin(about, "frame_seconds")
        return loaded, about.get("clip", path.stem), kept
    require(
        isinstance(model, Loaded),
        "model",
        expected="a VideoModel or an EditedVideo",
        got=short_repr(model),
        cure="End the chain with .video()." if type(model).__name__ == "Edit" else "The model comes first.",
    )
    return model, "foldgauss", {}


def _encode_model(model: Model, loaded: Loaded, metadata: dict) -> Iterator[str]:
    """The page's data blocks of the model, one by one; a compact file is embedded unchanged.

    `metadata` of the whole video goes into the first block.
    """
    if isinstance(loaded, SegmentedVideo):
        names = ("first", "num_frames", "num_gaussians")
        spans = [{name: int(getattr(segment, name)) for name in names} for segment in loaded.segments]
        yield f'<script type="application/json" id="segments">{json.dumps(spans)}</script>'
        for number, segment in enumerate(loaded.segments):
            edited = segment.model
            try:
                plain = flatten_video(edited)
            except ValueError as error:
                raise ValueError(f"segment {number}: {error}") from error
            yield _block(f"model-{number}", pack_compact(quantize_finely(plain), {} if number else metadata))
    else:
        yield _block("model", _pack(model, loaded, metadata))


def _pack(model: Model, loaded: VideoModel | EditedVideo, metadata: dict) -> bytes:
    """The compact file of a single model; one that is compact already is not changed."""
    if loaded is not model and _is_plain(model):
        return Path(model).read_bytes()
    return pack_compact(quantize_finely(flatten_video(loaded)), metadata)


def _is_plain(path: PathLike) -> bool:
    """Whether a file is a compact one of a single model, which the page decodes."""
    return is_compact(path) and not has_layers(path)


def _link(loaded: Loaded, name: str) -> str:
    """The page's block of a model in a file beside it."""
    require(
        not isinstance(loaded, SegmentedVideo),
        "linked",
        expected="a single model",
        got="one in segments",
        cure="Leave linked out.",
    )
    url = urllib.parse.quote(os.fsencode(name), safe="")
    return f'<script type="application/octet-stream" id="model" data-url="{url}"></script>'


def _find_objects(model: Loaded, moving: bool) -> dict[str, dict[int, str]]:
    """The Gaussians of each layer with a name, and of what is `moving`, by segment, as the page writes selections."""
    models = [one.model for one in model.segments] if isinstance(model, SegmentedVideo) else [model]
    found: dict[str, dict[int, str]] = {}
    missing = None
    for number, one in enumerate(models):
        first = 0
        for layer in as_edited(one).layers:
            own = np.zeros(one.num_gaussians, bool)
            own[first : first + layer.num_gaussians] = True
            first += layer.num_gaussians
            if layer.name:
                found.setdefault(layer.name, {})[number] = format_indices(Selection(own))
        try:
            text = format_indices(by_motion(flatten_video(one))) if moving else ""
        except NothingMoves as error:
            missing, text = error, ""
        if text:
            found.setdefault(MOVING, {})[number] = text
    if moving and MOVING not in found:
        raise missing or nothing_moves("an object that has Gaussians of its own", "none")
    return found


def quantize_finely(model: VideoModel) -> Quantized:
    """The model quantized in steps too fine to change the image, with its Gaussians in their order."""
    described = compute_columns(model)
    if described.paths is not None:
        paths = described.info.paths
        paths = dataclasses.replace(paths, bits=min(paths.bits + _MORE_PATH_BITS, MAX_PATH_BITS))
        described = dataclasses.replace(described, info=dataclasses.replace(described.info, paths=paths))
    classes = np.zeros(model.num_gaussians, np.int32)
    try:
        return quantize(described, classes, _fine_rules(model.degree))
    except ValueError:  # Gaussians so thin that steps in proportion would be beyond the format
        names = [name for name in column_names(model.degree) if not is_integral(name)]
        return quantize(described, classes, {name: Rule(0.0, _EVEN) for name in names})


def _fine_rules(degree: int) -> dict[str, Rule]:
    """Steps in proportion to a scale: paths to the shorter standard deviation, times to sigma_t.

    Features are class, size, stretch, duration, opacity, in this order.
    """
    rules = {name: Rule(0.0, -8.5) for name in ("size", "stretch", "duration", *COLORS)}
    rules["opacity"] = Rule(0.0, -7.5)
    rules["time"] = Rule(0.5, -9.0, (0.0, 0.0, 0.0, _PER_E))
    rules["angle"] = Rule(0.5, -10.5, (0.0, 0.0, -2 * _PER_E))
    by_width = (0.0, _PER_E, -_PER_E)
    return rules | {f"{axis}{k}": Rule(0.0, -7.5, by_width) for k in range(degree + 1) for axis in "xy"}


# -------------------------------------------------------------------------------------------- the original


def _encode_original(original: Frames, model: Loaded, quality: int) -> Iterator[str]:
    """The page's data blocks of the original's frames, as WebP."""
    frames = original.frames if isinstance(original, Clip) else original
    shape, dtype, own = np.shape(frames), getattr(frames, "dtype", None), (model.num_frames, *model.size, 3)
    require(
        len(shape) == 4 and shape[:3] == own[:3] and shape[3] in (3, 4) and dtype == np.uint8,
        "original",
        expected=f"frames uint8 {own}, those of the model",
        got=f"{dtype} {shape}",
        cure="Read them with read_video(path, size=model.size).",
    )
    for number, frame in enumerate(frames):
        bgr = frame[..., 2::-1]  # premultiplied colors without their alpha are the image over black
        done, data = cv2.imencode(".webp", bgr, [cv2.IMWRITE_WEBP_QUALITY, quality])
        require(
            done,
            "original",
            expected="frames that WebP can hold, up to 16,383 pixels a side",
            got=frame.shape,
        )
        yield _block(f"frame-{number}", data.tobytes())


# ------------------------------------------------------------------------------------------------ the page


def _assemble(blocks: list[str], title: str, save_to: SaveTarget | None = None, *, connects: bool = False) -> str:
    script, style = bundle_script("main.js"), (_SOURCES / "player.css").read_text(encoding="utf-8")
    parts = {
        "policy": _policy(script, style, connects=connects or save_to is not None),
        "title": html.escape(title.encode("utf-8", "replace").decode()),  # names of files need not be UTF-8
        "style": style,
        "data": "\n".join([*blocks, *(save_to.blocks() if save_to else ())]),
        "script": script,
    }
    page = (_SOURCES / "page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], page)


def _block(name: str, data: bytes, attributes: str = "") -> str:
    """Bytes as a script element of a type that browsers do not execute."""
    return f'<script type="application/octet-stream" id="{name}"{attributes}>{base64.b64encode(data).decode()}</script>'


def _policy(script: str, style: str, *, connects: bool) -> str:
    """The content security policy: the page's own script, style, images and worker, and its server if it has one."""
    allowed = {
        "default-src": "'none'",
        "script-src": _digest(script),
        "style-src": _digest(style),
        "img-src": "blob: data:",
        "worker-src": "blob:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    if connects:
        allowed["connect-src"] = "'self'"
    return "; ".join(f"{name} {value}" for name, value in allowed.items())


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def bundle_script(entry: str) -> str:
    """A module and all that it imports, each once, as one script without imports; texts become strings.

    Each module is a function of its own, so that names need not be unique, whose result are its exports.
    """
    done: dict[str, str] = {}

    def add(name: str) -> None:
        if name in done:
            return
        done[name] = ""  # so that a circle ends
        source = (_DECODER if name == _DECODER.name else _SOURCES / name).read_text(encoding="utf-8")
        for found in _IMPORT.finditer(source):
            if not found["text"]:
                add(found["name"])
        exports = ", ".join(_EXPORT.findall(source))
        source = re.sub(r"^export ", "", _IMPORT.sub(_as_constant, source), flags=re.MULTILINE)
        del done[name]
        done[name] = f"const {_module_variable(name)} = (() => {{\n{source}return {{ {exports} }};\n}})();\n"

    add(entry)
    return '"use strict";\n' + "\n".join(done.values())


def _as_constant(found: re.Match) -> str:
    """An import as constants: of a text, as of a shader, that text; of a module its exports."""
    if not found["text"]:
        return f"const {found['names']} = {_module_variable(found['name'])};\n"
    text = json.dumps((_SOURCES / found["name"]).read_text(encoding="utf-8")).replace("</", "<\\/")
    return f"const {found['text']} = {text};\n"


def _module_variable(name: str) -> str:
    return "module_" + re.sub(r"\W", "_", name)
