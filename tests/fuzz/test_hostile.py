"""What no file may do: run code, ask for memory that it does not hold, speak in a page; and files that did harm."""

import html
import json
import resource
import struct
import tracemalloc
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import foldgauss
from foldgauss.io import VideoError, html_page, read_masks, read_video, save_video_model, write_video
from foldgauss.io.history import HistoryFile

from . import media, models
from .models import sealed, tiny_model, unsealed
from .mutate import png_chunks, png_of
from .target import judge
from .test_fuzz import TARGETS

PACKAGE = Path(foldgauss.__file__).parent
HUGE = 2**40

TARGET = {target.name: target for target in TARGETS}

# ---------------------------------------------------------------------------------------------- no code is run


def test_arrays_are_read_without_pickle():
    """Other ways to run what a file says, such as `pickle` and `eval`, are found by ruff (rules S)."""
    for path in PACKAGE.rglob("*.py"):
        assert "allow_pickle=True" not in path.read_text(encoding="utf-8"), path


def test_no_picture_is_handed_to_another_program(tmp_path, monkeypatch):
    """Pillow gives PostScript to Ghostscript, whatever the file's name says."""
    script = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 4\n%%EndComments\n(a) = \n%%EOF\n"
    (tmp_path / "mask.png").write_bytes(script)
    Image.init()
    assert "EPS" in Image.ID  # it would
    monkeypatch.setattr("subprocess.Popen", lambda *_, **__: pytest.fail("a program was started"))
    monkeypatch.setattr("subprocess.check_call", lambda *_, **__: pytest.fail("a program was started"))
    with pytest.raises(ValueError, match="images that decode"):
        read_masks(tmp_path / "mask.png")


# ---------------------------------------------------------------------------------------------- room for what is there


@contextmanager
def _little_memory():
    """256 MB more than there is now, in Python and out of it."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (256 << 20), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _model(**facts) -> bytes:
    header, tensors = unsealed(TARGET["model"].seeds()[0])
    about = header["__metadata__"]
    about["header"] = json.dumps(json.loads(about["header"]) | facts)
    return sealed(header, tensors)


def _model_of_huge_tensors() -> bytes:
    header, tensors = unsealed(_model(num_gaussians=HUGE))
    for name, one in header.items():
        if name != "__metadata__":
            one["shape"] = [HUGE if n == 3 else n for n in one["shape"]]
    return sealed(header, tensors)


def _safetensors_header() -> bytes:
    return HUGE.to_bytes(8, "little") + TARGET["model"].seeds()[0][8:]


def _compact(seed: int = 0, paths: dict | None = None, chunk: dict | None = None, **facts) -> bytes:
    data = TARGET["compact"].seeds()[seed]
    length = int.from_bytes(data[12:16], "little")
    header = json.loads(data[20 : 20 + length]) | facts
    if paths is not None:
        header["paths"] |= paths
    if chunk is not None:
        header["chunks"][0] |= chunk
    header = json.dumps(header).encode()
    fixed = data[:12] + len(header).to_bytes(4, "little") + bytes(4)
    return models.compact_resealed(fixed + header + data[20 + length :])


def _chunk_of(num: int) -> dict:
    """A description that claims some Gaussians for no byte of its own."""
    return {"num_gaussians": num, "cells": [0, 0, 0], "visible": [0, 1], "streams": [0] * 16, "crc": 0}


def _ply(seed: int, old: bytes, new: bytes) -> bytes:
    data = TARGET["ply-vegas"].seeds()[seed]
    assert old in data
    return data.replace(old, new, 1)


def _png(width: int, height: int) -> bytes:
    chunks = png_chunks(TARGET["masks"].seeds()[1])
    chunks[0] = b"IHDR", struct.pack(">II", width, height) + chunks[0][1][8:]
    return png_of(chunks)


CLAIMS = {
    "model: Gaussians": ("model", lambda: _model(num_gaussians=HUGE)),
    "model: frames": ("model", lambda: _model(num_frames=HUGE)),
    "model: degree": ("model", lambda: _model(degree=2**31)),
    "model: tensors": ("model", _model_of_huge_tensors),
    "model: header": ("model", _safetensors_header),
    "compact: Gaussians": ("compact", lambda: _compact(chunk={"num_gaussians": HUGE})),
    "compact: streams": ("compact", lambda: _compact(chunk={"num_gaussians": 2**25, "streams": [2**30] * 16})),
    "compact: header": ("compact", lambda: TARGET["compact"].seeds()[0][:12] + b"\xff" * 8),
    "compact: chunks": ("compact", lambda: _compact(chunks=[_chunk_of(2000)] * 1000)),
    "compact: more chunks": ("compact", lambda: _compact(chunks=[_chunk_of(1)] * 1025)),
    "compact: frames": ("compact", lambda: _compact(num_frames=HUGE)),
    "compact: cells": ("compact", lambda: _compact(chunk={"cells": [24, 24, 24]})),
    "compact: degree": ("compact", lambda: _compact(degree=HUGE)),
    "compact: paths": ("compact", lambda: _compact(4, {"num_paths": HUGE})),
    "compact: most paths": ("compact", lambda: _compact(4, {"num_paths": 255, "num_knots": 2**15})),
    "compact: knots": ("compact", lambda: _compact(4, {"num_knots": HUGE})),
    "compact: bits": ("compact", lambda: _compact(4, {"bits": HUGE})),
    "ply: rows": ("ply-vegas", lambda: _ply(0, b"vertex 3", b"vertex %d" % HUGE)),
    "ply: rows as text": ("ply-vegas", lambda: _ply(1, b"vertex 3", b"vertex %d" % HUGE)),
    "ply: rows between": ("ply-vegas", lambda: _ply(3, b"extra 1", b"extra %d" % HUGE)),
    "ply: rows between as text": ("ply-vegas", lambda: _ply(4, b"extra 1", b"extra %d" % HUGE)),
    "masks: pixels": ("masks", lambda: _png(2**31 - 1, 2**31 - 1)),
    "masks: many pixels": ("masks", lambda: _png(2**15, 2**15)),
    "pictures: pixels": ("pictures", lambda: _png(2**31 - 1, 2**31 - 1)),
}


#: What is refused by the same check as another; the long runs take these.
SLOW = ("model: frames", "model: degree", "compact: more chunks", "compact: frames", "compact: degree")
SLOW += ("compact: knots", "compact: bits", "ply: rows between", "ply: rows between as text", "masks: pixels")


@pytest.mark.parametrize("claim", [pytest.param(k, marks=pytest.mark.slow if k in SLOW else []) for k in CLAIMS])
def test_what_a_header_claims_is_held_against_the_file(claim, tmp_path):
    name, build = CLAIMS[claim]
    target, path = TARGET[name], TARGET[name].path(tmp_path)
    target.prepare(tmp_path)
    path.write_bytes(target.seeds()[0])
    assert judge(target, path) == "accepted"  # and what is made once is made
    path.write_bytes(build())
    tracemalloc.start()
    try:
        with _little_memory():
            outcome = judge(target, path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert outcome in {error.__name__ for error in target.errors}
    assert peak < 16 << 20


#: First bytes of files of other kinds, and texts.
OTHERS = (
    b"\x89PNG\r\n\x1a\n" + bytes(60),
    b"ply\nformat ascii 1.0\n",
    b"PK\x03\x04" + bytes(60),
    b"hello",
    b"{",
    b"[" * 999,
)


@pytest.mark.parametrize("target", models.TARGETS, ids=lambda target: target.name)
def test_a_file_cut_off_anywhere_or_of_another_kind_is_refused(target, tmp_path):
    target.prepare(tmp_path)
    path = target.path(tmp_path)
    for seed in target.seeds()[:2]:
        for data in (*(seed[:length] for length in range(0, len(seed), 1 + len(seed) // 200)), *OTHERS):
            path.write_bytes(data)
            assert judge(target, path) != "accepted", len(data)


# ---------------------------------------------------------------------------------------------- once did harm


@pytest.mark.parametrize(
    ("name", "data", "outcome"),
    [
        ("history", b'{"step":' + b"[" * 100_000 + b"\n", "ValueError"),
        ("history", b'{"step": 1, "psnr": "high"}\n', "ValueError"),
        ("history", b'{"step": 1, "stopped_by": []}\n', "ValueError"),
        ("history", b'{"step": true}\n', "ValueError"),
        # Python writes no decimal number of more than 4,300 digits, but tomllib reads hexadecimal ones.
        ("edit-script", b"[[edits]]\ndo = 0x" + b"f" * 4000 + b"\n", "EditScriptError"),
        # Lines that go on: joined one by one, these would be copied for minutes.
    ],
    ids=lambda value: str(value)[:30],
)
def test_what_once_did_harm_is_refused(name, data, outcome, tmp_path):
    target = TARGET[name]
    target.prepare(tmp_path)
    target.path(tmp_path).write_bytes(data)
    assert judge(target, target.path(tmp_path)) == outcome


def test_a_history_without_psnr_is_another_fits(tmp_path):
    line = '{"step": 5, "progress": 0.5, "loss": 0.1, "psnr": null, "num_gaussians": 9, "num_alive": 9, '
    (tmp_path / "h.jsonl").write_text(line + '"seconds": 1.0, "seconds_left": 1.0, "stopped_by": null}\n')
    with pytest.raises(ValueError, match="that of the fit which is resumed"):
        HistoryFile(tmp_path / "h.jsonl", resumed_at=5, psnr=20.0)


@pytest.mark.parametrize("side", [2**13, 2**15])  # beyond our limit, and beyond Pillow's
def test_a_mask_too_large_for_its_file_is_called_so(side, tmp_path):
    (tmp_path / "m.png").write_bytes(_png(side, side))
    with pytest.raises(ValueError, match=r"images that decode, got|images of at most 178,956,970 pixels"):
        read_masks(tmp_path / "m.png")


def test_good_neighbors_are_still_read(tmp_path):
    """Large and plain pictures are no bombs: the limit is far from them."""
    plain = np.zeros((4320, 7680), np.uint8)
    plain[:10] = 1
    Image.fromarray(plain).save(tmp_path / "m.png")
    assert (tmp_path / "m.png").stat().st_size < 50_000
    assert read_masks(tmp_path / "m.png").sum() == 10 * 7680


# ---------------------------------------------------------------------------------------------- what a page shows

EVIL = [
    "</script><script>alert(1)</script>",
    "</title><img src=x onerror=alert(1)>",
    '</title></script><script>alert(1)</script><b onclick="x">&{{script}}',
    "\"' onmouseover='alert(1)' x=\"",
    "<!--<script>",
    "a\u2028b\u2029c\x85",
    "]]>{{script}}{{data}}\\g<0>\\1",
    "&lt;b&gt;&amp;",
    "a\ud800b",
    "\x00\x1b[31m\x7f",
    "${alert(1)}`",
]


@pytest.mark.parametrize(
    "evil", [*EVIL[:3], *(pytest.param(evil, marks=pytest.mark.slow) for evil in EVIL[3:])], ids=repr
)
def test_a_page_shows_every_string_as_text(evil, tmp_path):
    """The name in a model's metadata, that of its file, a title given: whatever a stranger can choose."""
    kept = save_video_model(tmp_path / "m.safetensors", tiny_model(), metadata={"clip": evil})
    name = evil.replace("/", "_").replace("\0", "").encode("utf-8", "replace").decode()
    named = save_video_model(tmp_path / f"{name}.safetensors", tiny_model())
    for page, model, title in (
        (html_page(tiny_model(), title=evil), tiny_model(), evil),
        (html_page(kept), kept, evil),
        (html_page(named), named, name),
    ):
        shown = html.escape(title.encode("utf-8", "replace").decode())
        assert page == html_page(model, title="in place of it").replace("in place of it", shown)


def test_scripts_set_text_and_never_markup():
    """So what a compact file's header says cannot become an element, whatever it is."""
    scripts = [*sorted((PACKAGE / "io" / "page" / "player").glob("*.js")), PACKAGE / "io" / "page" / "compact.js"]
    assert len(scripts) > 5
    words = ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval(", "new Function", "srcdoc")
    for path in scripts:
        assert [word for word in words if word in path.read_text(encoding="utf-8")] == [], path.name


def test_a_box_of_any_64_bits_is_passed_by(tmp_path):
    box = b"\0\0\0\x10ftypisom\0\0\0\0" + b"\0\0\0\1free" + b"\xff" * 8
    (tmp_path / "a.mp4").write_bytes(box)
    with pytest.raises(VideoError, match="does not open as a video"):
        read_video(tmp_path / "a.mp4")


def test_a_gif_whose_frame_grows_is_damaged_there(tmp_path):
    """Pillow enlarges the picture for it."""
    frames = np.random.default_rng(0).integers(0, 255, (3, 16, 24, 3), np.uint8)
    data = bytearray(write_video(tmp_path / "clip.gif", frames, 10).read_bytes())
    last = data.rindex(b"\x2c" + struct.pack("<HHHH", 0, 0, 24, 16))
    data[last + 7 : last + 9] = struct.pack("<H", 144)
    (tmp_path / "clip.gif").write_bytes(data)
    clip = read_video(tmp_path / "clip.gif")
    assert clip.frames.shape == (2, 16, 24, 3)
    assert clip.num_declared == 3


def test_a_moving_png_without_frames_is_refused(tmp_path):
    """Pillow warns of it, and warnings are errors here."""
    data = bytearray(media._more_images()[-1])
    at = data.index(b"acTL")
    data[at + 4 : at + 8] = bytes(4)
    data[at + 12 : at + 16] = zlib.crc32(data[at : at + 12]).to_bytes(4, "big")
    (tmp_path / "picture.png").write_bytes(data)
    with pytest.raises(VideoError, match="images that decode"):
        read_video(tmp_path / "picture.png")
