"""Wrong use of any command: its exit code, one line that says what is wrong, no long work, and nothing written."""

import dataclasses
import os
import re
import shlex

import cv2
import numpy as np
import pytest
from commands import call, write_tone
from soft_models import soft_model, soft_segments
from tiny_clips import model_of_12, write_both

from foldgauss.io import load_video_model, save_video_model, write_video
from foldgauss.video import edit


def write_pictures(folder, *pictures):
    folder.mkdir()
    for k, picture in enumerate(pictures):
        assert cv2.imwrite(str(folder / f"{k}.png"), picture)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Clips, models, scripts and masks, right and wrong ones."""
    folder = tmp_path_factory.mktemp("inputs")
    write_both(folder)
    model, gray = load_video_model(folder / "model.safetensors"), np.zeros((40, 64, 3), np.uint8)
    write_video(folder / "clip.mp4", model.frames(), 12.0)
    data = (folder / "model.safetensors").read_bytes()
    for name, content in {
        "text.mp4": b"not a video",
        "cut.mp4": (folder / "clip.mp4").read_bytes()[:300],
        "other.safetensors": b"ply\nformat ascii 1.0\n",
        "short.safetensors": data[:-50],
        "later.safetensors": data.replace(b'"version":"1"', b'"version":"9"'),
        "x.ply": b"ply\nformat ascii 1.0\nend_header\n",
        "file": b"precious",
        "there.ply": b"precious",
        "dark.toml": b'[[edits]]\ndo = "recolor"\ngain = 0.5\n',
        "key.toml": b'[[edits]]\ndo = "vanish"\n\n[[edits]]\ndo = "move"\nofset = [1, 0]\n',
        "box.toml": b"[selections.it]\nbox = [900, 900, 901, 901]\nframe = 0",
        "inputs.toml": b'[selections.it]\nmask = "in"\n[[layers]]\nmodel = "in.safetensors"\n',
        **dict.fromkeys(("in.mp4", "in.safetensors", "in.html", "in.fgz", "in.json"), b"precious"),
    }.items():
        (folder / name).write_bytes(content)
    for name, video in {
        "edited": edit(model_of_12()).move((0.1, 0), frame=3).video(),
        "segments": soft_segments(),
        "two": soft_model(num_frames=2),
        "one": soft_model(num_frames=1),
        "fast": dataclasses.replace(model, fps=60.0),
    }.items():
        save_video_model(folder / f"{name}.safetensors", video)
    save_video_model(folder / "own.safetensors", model, metadata={"clip": "clip"})
    for name in ("bad/chains.h5", "mine/notes.txt", "in/0.png", "left/models", "plot/tradeoff.png"):
        (folder / name).parent.mkdir()
        (folder / name).write_text("precious")
    write_pictures(folder / "mixed", gray[:, :40], gray[:, :50])
    write_pictures(folder / "alpha", *[np.full((40, 64, 4), 100, np.uint8)] * 3)
    write_pictures(folder / "three", *[gray + 255] * 3)
    write_pictures(folder / "empty", gray)
    write_tone(folder / "tone.wav", 1.0)
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe.png")
    return folder


FIT, RENDER = "fit clip.mp4 --out out.safetensors", "render model.safetensors --out"
EDIT, VIEW = "edit model.safetensors dark.toml --out", "view model.safetensors --out"
STABLE = "render model.safetensors --stabilize smooth"
SMALL, COMPRESS = "fit clip.mp4 --gaussians 400 --steps 30 --out out.fgz", "compress model.safetensors"
PLY, SCENES = "export model.safetensors --format ply", "export model.safetensors --format ply3dgs"
TRADEOFF, TIMES = "tradeoff clip.mp4 --out r --steps 12", "uncertainty model.safetensors clip --out"
WRONG = [
    # of several commands
    *(
        (f"{words} --overwrite", 2, r"Inputs are never replaced\.")
        for words in (
            f"{RENDER} in.mp4 --sound in.mp4",
            "fit clip.mp4 --masks in --out in",
            "fit clip.mp4 --masks in.fgz --out in.fgz",
            "edit model.safetensors inputs.toml --sound in.mp4 --out in.mp4",
            "edit model.safetensors inputs.toml --out in",
            "edit model.safetensors inputs.toml --out in.safetensors",
            "edit in.safetensors inputs.toml --out in.safetensors",
            f"{VIEW} in.html --original in.html",
            f"{COMPRESS} in.fgz --out in.fgz",
            "evaluate model.safetensors in.json --json in.json",
            "evaluate in.safetensors in.mp4 --json in.safetensors",
            "fit in.safetensors --out in.safetensors",
        )
    ),
    ("render model.safetensors --sound pipe.png", 2, "pipe.png"),
    # To open a pipe would wait for a program that writes to it.
    *(
        (words, 1, "pipe.png")
        for words in (
            "info pipe.png",
            "view pipe.png",
            "render pipe.png",
            "view pipe.png --out p.html",
            "uncertainty pipe.png clip.mp4",
            "evaluate model.safetensors pipe.png",
            "fit pipe.png",
            "edit model.safetensors pipe.png",
            "fit clip.mp4 --masks pipe.png",
            "import pipe.png",
        )
    ),
    # fit
    ("fit none.mp4 --out out.safetensors", 2, "missing"),
    ("fit text.mp4 --out out.safetensors", 1, "text.mp4"),
    ("fit cut.mp4 --out out.safetensors", 1, "cut.mp4"),
    ("fit mixed --out out.safetensors", 1, "40x50|50x40"),
    ("fit https://a.org/clip.mp4 --out o", 2, r"the address 'https://a.org/clip.mp4'. Download it first\."),
    ("fit alpha --out out.safetensors --compositing sum", 2, "compositing: expected 'over' for frames with alpha"),
    ("fit loop", 2, r"got 'loop', which cannot be reached \(Too many levels of symbolic links\)"),
    ("fit ''", 2, "arguments: expected a value for each, got an empty one"),
    ("fit clip --out m.safetensors --history clip/h.jsonl", 2, "error: --history: expected a place outside the clip's"),
    ("fit clip.mp4 --out clip.mp4 --overwrite", 2, "another path than the clip"),
    ("fit clip.mp4 --out m.mp4", 2, "--out: expected a name ending in .fgz, or in .safetensors"),
    ("fit clip.mp4 --out m.bin", 2, "--out: .* in .safetensors for parameters that are not rounded"),
    ("fit clip.mp4 --out clip.mp4/m.safetensors", 1, "folder"),
    ("fit clip.mp4 --out mixed --overwrite", 1, "file"),
    ("fit clip.mp4 --speed 9", 2, "--speed"),
    *((f"{FIT} --frames {frames}", 2, f"frames.*{says}") for frames, says in (("2:2", "at least 1"), ("4", "A:B"))),
    *((f"{FIT} --frames {frames}", 2, "frames: expected") for frames in ("98:99", "4:2")),
    *((f"{FIT} --size {size}", 2, "--size: expected HxW") for size in ("0x10", "48")),
    (f"{FIT} --size 100000x100000", 2, "GiB"),
    (f"{FIT} --frames 4:8 --masks three", 2, "masks: expected one of a frame from 4 to 7, got others in"),
    (f"{FIT} --masks empty", 2, "masks: expected an object in them, got none in"),
    ("fit two.safetensors --masks moving", 2, "frames: expected uint8 .* of 3 or more frames"),
    ("fit other.safetensors", 1, "other.safetensors"),
    ("fit short.safetensors", 1, "short.safetensors"),
    ("fit model.safetensors --frames 12:", 2, "frames: expected A:B within 0:12"),
    ("fit model.safetensors --segment-seconds 1", 2, "--segment-seconds: expected a clip for segments, got the model"),
    (f"{FIT} --degree 99", 2, "degree"),
    (f"{FIT} --preset best", 2, "--preset: expected one of.*'paper'"),
    (f"{FIT} --max-gaussians 0", 2, "--max-gaussians"),
    (f"{FIT} --gaussians 0", 2, "--gaussians: expected a whole number >= 1"),
    (f"{FIT} --minutes 0", 2, "minutes"),
    (f"{FIT} --quality 101", 2, r"--quality: expected a number in \[0, 100\]"),
    *((f"{FIT} --psnr {psnr}", 2, r"--psnr: expected a number in \(0, 100\]") for psnr in (0, -1)),
    (f"{FIT} --size-mb 1", 2, "--size-mb: expected a compact file, got.*m?.fgz"),
    (f"{FIT} --history h.txt", 2, "--history: expected a name ending in .jsonl"),
    (f"{FIT} --quiet --log-json", 2, "--quiet: .*both"),
    (f"{FIT} --segment-seconds 2 --history h.jsonl", 2, "--history: expected a fit in one piece"),
    (f"{FIT} --workers 2 --scheduler tcp://127.0.0.1:1", 2, "--workers: expected no --scheduler"),
    (f"{FIT} --threads 2", 2, "--threads: expected --workers"),
    (f"{FIT} --segment-seconds -1", 2, "--segment-seconds: expected a number of seconds > 0"),
    (f"{FIT} --workers 0", 2, "--workers"),
    (f"{SMALL} --size-mb 0.001", 2, "--size-mb: expected at least 0.00"),
    (f"{SMALL} --size-mb 0.003 --segment-seconds 0.2", 2, "--size-mb: expected more than 0.0"),
    ("fit-many . --out .", 2, "another folder than the clips'"),
    ("fit-many none", 2, "none"),
    ("fit-many clip.mp4", 2, "foldgauss fit"),
    ("fit-many no:smile:folder", 2, "no:smile:folder"),
    (f"fit-many {300 * 'x'}", 1, "error: path: expected one that can be used, got 'xxx"),
    # render
    ("render none --out v.mp4", 2, "none"),
    ("render m --out=", 2, "arguments: expected a value for each, got an empty one"),
    (f"{RENDER} v.avi", 2, "mp4"),
    (f"{RENDER} {300 * 'x'}", 1, "error: path: expected one that can be used, got 'xxx"),
    (f"{RENDER} v.mp4 --size 90000x90000", 2, "memory"),
    (f"{RENDER} v.mp4 --size 0x0", 2, "HxW"),
    (f"{RENDER} f --times 0 --speed 2", 2, "--speed and --times"),
    (f"{RENDER} f --fps 0", 2, "--fps"),
    (f"{RENDER} f --speed 0", 2, "--speed"),
    (f"{RENDER} f --times 0,1.5", 2, "--times"),
    (f"{RENDER} f --times 0:1", 2, "--times"),
    *((f"{RENDER} f --remap {remap}", 2, "--remap") for remap in ("0,1", "0=0,1e15=1", "0=0,2=1,1=1")),
    (f"{RENDER} f --speed 1e-4 --fps 900", 2, "expected at most 1,000,000 images"),
    (f"{RENDER} f --background red", 2, "--background: .*RRGGBB"),
    (f"{RENDER} v.gif --background none", 2, "--background: expected a color for .gif"),
    (f"{RENDER} v.webp --background none", 2, "--background: expected a color for .webp"),
    (f"{RENDER} a.png --frame 12", 2, "--frame: expected a frame from -12 to 11, got 12"),
    (f"{RENDER} a.png --frame 1 --times 0.5", 2, "--frame|--times"),
    (f"{RENDER} a.png", 2, "--out: expected one image for a .png, got 12 images. Choose it by --times T"),
    (f"{RENDER} a.png --frame 0 --codec h264", 2, "--codec: expected a video file"),
    (f"{RENDER} a.mp4 --crf 52", 2, "--crf: expected a whole number from 0 to 51"),
    (f"{RENDER} a.gif --codec h264", 2, "--codec: expected a video file"),
    (f"{RENDER} a.mp4 --pixel-format rgb24", 2, "--pixel-format: expected one of"),
    (f"{RENDER} a.mp4 --sound clip.mp4", 2, "--sound: expected a file with sound"),
    (f"{RENDER} a.mp4 --sound no.mp4", 2, "which is missing"),
    (f"{RENDER} a.mp4 --sound tone.wav --speed -1", 2, "forwards"),
    *(
        (f"{words} --{option} -1", 2, f"--{option}: expected a number in")
        for words in (f"{RENDER} x.mp4", "evaluate model.safetensors clip")
        for option in ("alpha-cutoff", "support-radius", "transmittance-stop")
    ),
    # render --stabilize
    (f"{STABLE} --border blur", 2, "--border: expected one of 'crop', 'fill', 'keep', got 'blur'"),
    ("render model.safetensors --stabilize no", 2, "--stabilize: expected one of 'smooth', 'fixed', got 'no'"),
    (f"{STABLE} --smoothing 0", 2, "--smoothing: expected seconds > 0, got 0.0"),
    ("render model.safetensors --stabilize fixed --smoothing 1", 2, "--stabilize fixed: expected no --smoothing, got"),
    (f"{STABLE} --layer object", 2, "--layer: expected a file with layers, as fit --masks writes it, got 'object'"),
    (f"{STABLE} --crf 99", 2, "--crf: expected"),
    (f"{STABLE} --background none", 2, "--out: expected RGB for h264 in .mp4"),
    (f"{STABLE} --background none --out x.gif", 2, "--background: expected a color for .gif, got none"),
    (f"{STABLE} --fps 60 --out x.gif", 2, "--out: expected at most 50 frames per second in it, got 60 for x.gif"),
    (f"{STABLE} --out x.png", 2, "--out: expected one image for a .png"),
    (f"{STABLE} --size 0x3", 2, "--size: expected HxW"),
    *(
        (f"{RENDER} {words} --overwrite", 1, f"expected {told}")
        for words, told in (
            ("mine", "an empty folder or one of numbered frames, got 'mine' with 'notes.txt'"),
            ("file", "a folder for frames, got the file 'file'"),
        )
    ),
    (f"{RENDER} x.mp4 --codec divx", 2, "--codec: expected"),
    (f"{RENDER} x.mp4 --codec av1", 2, "--out: expected at least 64x64 for av1"),
    (f"{RENDER} images --codec h264", 2, r"--codec: expected a video file for it, got 'images'\."),
    ("edit fast.safetensors dark.toml --out x.gif", 2, "--out: expected at most 50 frames per second in it, got 60"),
    # edit
    ("edit model.safetensors none.toml --out o.safetensors", 2, "none.toml"),
    ("edit none.safetensors dark.toml --out o.safetensors", 2, "none.safetensors"),
    ("edit model.safetensors loop", 2, "got 'loop', which cannot be reached"),
    (
        "edit model.safetensors key.toml --out o.safetensors",
        1,
        r"key.toml, \[\[edits\]\] number 2: ofset: expected one of.* Did you mean 'offset'\?",
    ),
    ("edit model.safetensors box.toml --out o.safetensors", 1, r"box.toml, \[selections.it\]: box: "),
    (f"{EDIT} o.safetensors --size 20x32", 2, "--size"),
    (f"{EDIT} o.safetensors --sound tone.wav", 2, "--sound: expected a video as --out"),
    (f"{EDIT} images --sound tone.wav", 2, "--sound: expected a video file for it, got 'images'"),
    (f"{EDIT} silent.mp4 --sound none.wav", 2, "which is missing"),
    (f"{EDIT} out.png", 2, ".safetensors.*foldgauss render MODEL --times T --out FILE.png"),
    # evaluate, info, compress
    ("evaluate model.safetensors https://a.org/clip.mp4 --json o", 2, "the address 'https://a.org/clip.mp4'"),
    ("evaluate model.safetensors clip --json model.safetensors/f.json", 1, "folder"),
    ("evaluate model.safetensors clip --frames 0:3", 2, "12 frames"),
    ("info other.safetensors", 1, "other.safetensors"),
    ("info short.safetensors", 1, "short.safetensors"),
    ("info later.safetensors", 1, "version"),
    (f"{COMPRESS} --out m.zip", 2, "--out: expected a name ending in .fgz"),
    (f"{COMPRESS} --quality 101", 2, "--quality"),
    (f"{COMPRESS} --size-mb 0", 2, r"--size-mb: expected a number in \(0, inf\)"),
    (f"{COMPRESS} --size-mb 0.001", 2, "--size-mb: expected at least"),
    (f"{COMPRESS} --psnr nan", 2, r"--psnr: expected a number in \(0, 100\]"),
    (f"{COMPRESS} --frames 0:5", 2, "--frames: expected a VIDEO"),
    (f"{COMPRESS} --psnr 30", 2, "--psnr: expected none without the clip"),
    (f"{COMPRESS} --minutes 5", 2, "--minutes: expected none without the clip"),
    (f"{COMPRESS} nowhere.mp4", 2, "nowhere.mp4"),
    ("compress loop", 2, "got 'loop', which cannot be reached"),
    ("compress edited.safetensors --out e.fgz", 2, "MODEL: expected a plain model, got one with edits, or of layers"),
    *(
        (words, 2, "MODEL: expected a model of one piece, got one in segments. Extract one: foldgauss export")
        for words in ("compress segments.safetensors", "uncertainty segments.safetensors clip")
    ),
    # export, import
    ("export edited.safetensors --format ply --out v.ply", 2, "one with edits"),
    ("export model.safetensors --format fbx --out v.ply", 2, "--format"),
    (f"{PLY} --out folder", 2, "--out"),
    ("export model.safetensors --format obj --out v.ply", 2, "--out"),
    (f"{PLY} --out v.ply --times 0.5", 2, "--times"),
    (f"{SCENES} --out v.ply", 2, "times: expected one"),
    (f"{PLY} --out there.ply", 2, "--overwrite"),
    ("export one.safetensors --format ply --out v.ply", 1, "at least 2 frames"),
    ("export segments.safetensors --format ply --out one.ply", 2, "expected a folder without extension"),
    ("export segments.safetensors --format model --segment 3", 2, "--segment: expected a whole number from 0 to 2"),
    ("export model.safetensors --format model --segment 0", 2, "MODEL: expected a model in segments, got one without"),
    ("export segments.safetensors --format model --segment 1 --out one.mp4", 2, "--out: expected a name ending in .s"),
    ("export segments.safetensors --format model --segment 0 --out segments.safetensors", 2, "--out"),
    ("export segments.safetensors --format model --segment 0 --times 0.5", 2, "--times: expected ply3dgs or obj"),
    ("export model.safetensors --format obj --out mine --overwrite", 1, "got"),
    ("import there.ply --out m.safetensors", 1, "there.ply"),
    ("import there.ply --out m.ply", 2, "--out"),
    ("import none.ply --out m.safetensors", 2, "missing"),
    # view
    (f"{VIEW} clip.htm", 2, "--out: expected a name ending"),
    (f"{VIEW} c.html --moving-object", 2, "--out: expected no --moving-object, got both"),
    ("view model.safetensors --linked", 2, "--linked: expected --out too"),
    ("view --out c.html --original model.safetensors", 2, "--out without MODEL: expected no --original"),
    ("view", 2, "MODEL: expected a model file, or --out"),
    ("view edited.safetensors --out c.html", 1, "foldgauss render"),
    ("view edited.safetensors --no-browser", 1, "edits that no folded model represents"),
    ("view none.fgz", 2, "none.fgz"),
    ("view loop", 2, "got 'loop', which cannot be reached"),
    ("view x.ply", 1, "foldgauss import"),
    ("view model.safetensors --original none.mp4 --no-browser", 2, "none.mp4"),
    # tradeoff
    (f"{TRADEOFF} --axes time,speed", 2, "--axes: expected some of time, gaussians, degree"),
    (f"{TRADEOFF} --axes ,", 2, "--axes: expected some of"),
    *((f"{TRADEOFF} --minutes {minutes}", 2, "--minutes: expected a number above 0") for minutes in (0, "nan")),
    (f"{TRADEOFF} --seed -1", 2, "--seed: expected a whole number >= 0"),
    (f"{TRADEOFF} --size 9", 2, "--size: expected HxW"),
    *(
        (f"tradeoff clip.mp4 --out {folder} --steps 12", 2, f"with {name!r} in it, but no tradeoff.json of a tradeoff")
        for folder, name in (("left", "models"), ("plot", "tradeoff.png"))
    ),
    # uncertainty
    (f"{TIMES} o --noise white", 2, "--noise: expected one of 'score', 'independent'"),
    (f"{TIMES} o --concentration 0", 2, "--concentration: expected a number >= 1"),
    (f"{TIMES} o --ensembles 1", 2, "--ensembles: expected at least 2"),
    (f"{TIMES} o --steps 3", 2, "--steps: expected a whole number >= 10"),
    (f"{TIMES} o --frames 0:2", 2, "--frames: expected at least 3 frames"),
    (f"{TIMES} clip", 2, "a place outside the clip's folder"),
    (f"{TIMES} file", 2, "--out: expected a folder"),
    (f"{TIMES} bad", 2, "got others in"),
    (f"{TIMES} three", 2, "a new folder or one that a run of uncertainty wrote"),
    ("uncertainty own.safetensors clip --out o --frames 0:5", 2, "Give all of them"),
    ("uncertainty none clip --out o", 2, "missing"),
    ("uncertainty edited.safetensors clip --out o", 2, "an edited one"),
    ("uncertainty one.safetensors empty/0.png --out o", 2, "at least 3 frames"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "code", "says"), WRONG, ids=lambda value: str(value)[:90])
def test_wrong_use_is_told_in_one_line_before_any_work(inputs, monkeypatch, words, code, says):
    if words.startswith("uncertainty"):
        pytest.importorskip("emcee", reason="draws need foldgauss[uncertainty]")
    monkeypatch.chdir(inputs)
    monkeypatch.setattr("foldgauss.video.motion.stabilization.estimate_camera_path", None)  # nothing gets so far
    before = contents_of(inputs)
    shown, told = call(*shlex.split(words), code=code)
    assert re.search(says, " ".join(told.split())), told
    assert "Traceback" not in told
    assert "Searching" not in shown
    if "Usage:" not in told:  # typer's own words on usage take several lines
        assert len(told.strip().splitlines()) == 1, told
    assert contents_of(inputs) == before


def contents_of(folder):
    """The bytes of all files, and the names of all folders and links."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}
