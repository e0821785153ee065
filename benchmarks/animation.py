"""The animated picture of README: a clip, its model at quarter speed, and its object multiplied.

    python -m benchmarks.animation [--out FILE] [--models FOLDER] [--still FILE] [--json FILE]

24 frames of *Bunny* (Big Buck Bunny, Blender Foundation, CC BY 3.0) at 360x640, fitted with the default settings. The
masks of the rabbit are made here, by a rough outline on ten frames and by color (GrabCut) on all. `--models` keeps the
model, and takes the one that is there; `--still` writes one frame of the animation as a PNG, to look at; `--json`
writes quality, size and processor time of the fit (seconds are processor time divided by the number of threads).
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from benchmarks import _common, _runs
from foldgauss.io import Clip, load_video_model, save_video_model
from foldgauss.io._atomic import atomic_path
from foldgauss.io.datasets import bunny
from foldgauss.video import EditedVideo, FitConfig, VideoModel, by_mask, edit, layers

FRAMES = (34, 58)
SIZE = (360, 640)
#: The first frame shown: copies are delayed, and before the first frame of the model there is no time.
FIRST = 4
#: Times of the slow panels for each frame.
SLOWDOWN = 4
#: Time that each picture is shown.
MILLISECONDS = 40
QUALITY = 45

# fmt: off
#: Rough outlines of the rabbit by frame, (x, y) in pixels: body with arms, and both ears.
BODY = {
    0: [(78, 126), (98, 178), (135, 160), (150, 175), (138, 205), (145, 240), (175, 278), (230, 300), (260, 300),
        (267, 265), (275, 237), (298, 210), (308, 225), (322, 238), (338, 205), (302, 148), (285, 122), (250, 115),
        (225, 120), (170, 120), (130, 138)],
    3: [(78, 128), (112, 178), (150, 162), (165, 170), (143, 215), (148, 245), (185, 282), (235, 300), (264, 300),
        (272, 260), (282, 215), (287, 180), (322, 183), (340, 202), (349, 160), (312, 128), (282, 102), (247, 98),
        (225, 106), (170, 116), (130, 138)],
    6: [(100, 132), (112, 157), (140, 150), (172, 150), (146, 210), (148, 250), (190, 287), (240, 302), (267, 302),
        (277, 270), (292, 220), (298, 150), (335, 142), (350, 152), (347, 113), (300, 96), (272, 78), (235, 75),
        (220, 90), (180, 96), (130, 110)],
    9: [(112, 108), (122, 129), (150, 116), (178, 130), (146, 205), (153, 255), (190, 292), (240, 305), (268, 302),
        (282, 270), (294, 200), (295, 100), (325, 90), (347, 97), (337, 63), (290, 70), (262, 56), (220, 54),
        (208, 73), (180, 73), (138, 83)],
    12: [(115, 73), (126, 97), (165, 96), (180, 120), (153, 200), (158, 250), (190, 287), (240, 305), (270, 305),
         (287, 265), (298, 200), (290, 105), (300, 74), (323, 56), (320, 33), (293, 28), (262, 60), (216, 42),
         (205, 70), (185, 70), (137, 61)],
    14: [(111, 58), (120, 82), (155, 94), (182, 125), (154, 200), (159, 250), (190, 287), (240, 305), (270, 305),
         (287, 265), (299, 200), (284, 105), (293, 60), (309, 38), (300, 18), (272, 15), (248, 57), (212, 42),
         (202, 70), (180, 70), (141, 44)],
    16: [(109, 52), (117, 71), (150, 87), (180, 130), (157, 200), (160, 250), (190, 287), (238, 305), (270, 306),
         (287, 268), (300, 203), (283, 105), (280, 52), (297, 38), (290, 14), (260, 10), (248, 56), (208, 42),
         (200, 72), (177, 70), (136, 34)],
    18: [(102, 45), (112, 68), (146, 88), (180, 135), (159, 200), (162, 250), (190, 287), (237, 306), (270, 308),
         (287, 270), (302, 206), (280, 95), (276, 50), (288, 36), (282, 14), (250, 10), (242, 50), (208, 40),
         (200, 74), (173, 70), (128, 32)],
    21: [(96, 48), (108, 70), (142, 90), (180, 138), (160, 200), (163, 250), (190, 287), (236, 307), (270, 309),
         (287, 273), (303, 208), (279, 85), (273, 50), (283, 38), (276, 16), (250, 15), (244, 50), (206, 38),
         (196, 75), (174, 71), (122, 34)],
    23: [(91, 43), (105, 72), (140, 92), (180, 140), (160, 200), (163, 250), (190, 287), (235, 307), (270, 310),
         (287, 275), (304, 210), (278, 85), (272, 52), (284, 37), (277, 16), (248, 18), (246, 52), (206, 37),
         (196, 75), (174, 71), (122, 34)],
}
LEFT_EAR = {
    0: [(257, 121), (249, 91), (258, 67), (273, 91), (273, 121)],
    3: [(254, 102), (249, 75), (257, 44), (270, 75), (273, 102)],
    6: [(240, 77), (233, 45), (241, 18), (254, 45), (256, 77)],
    9: [(221, 56), (211, 32), (220, 4), (233, 32), (234, 56)],
    12: [(216, 54), (193, 49), (180, 31), (194, 27), (216, 46)],
    14: [(214, 55), (190, 57), (168, 49), (188, 43), (214, 47)],
    16: [(213, 54), (188, 58), (162, 54), (188, 45), (213, 47)],
    18: [(209, 53), (180, 57), (159, 50), (180, 42), (209, 45)],
    21: [(205, 53), (178, 56), (156, 46), (176, 40), (205, 44)],
    23: [(204, 53), (178, 56), (155, 46), (176, 40), (204, 44)],
}
RIGHT_EAR = {
    0: [(280, 126), (292, 97), (318, 84), (310, 104), (292, 122)],
    3: [(276, 103), (290, 78), (323, 75), (312, 88), (290, 100)],
    6: [(259, 80), (278, 52), (308, 52), (292, 64), (271, 78)],
    9: [(242, 58), (258, 32), (285, 24), (272, 40), (255, 56)],
    12: [(227, 46), (225, 28), (239, 14), (245, 28), (243, 46)],
    14: [(218, 45), (217, 33), (224, 24), (233, 33), (233, 45)],
    16: [(212, 47), (213, 37), (221, 32), (230, 40), (232, 45)],
    18: [(212, 45), (215, 35), (223, 30), (230, 38), (232, 44)],
    21: [(207, 42), (209, 32), (216, 28), (223, 34), (226, 42)],
    23: [(206, 42), (208, 31), (215, 27), (222, 33), (225, 42)],
}
# fmt: on
#: Pixels that the outline of the body may be off, inward and outward.
BODY_OFF = (9, 8)
#: The same for the outlines of the ears.
EARS_OFF = (4, 4)
#: The cave behind the rabbit is darker than this, of 255.
DARK = 24
#: The cave is above this row.
DARK_ROWS = 270
#: Fraction of the contribution of a Gaussian of a copy that lies in the masks.
WITHIN = 0.7
#: Fraction that lies in the masks grown by `GROWN` pixels.
WITHIN_GROWN = 0.97
GROWN = 3


class Copy(NamedTuple):
    """A copy of the rabbit: where its feet are in pixels, its size, and its delay in frames."""

    feet: tuple[float, float]
    scale: float
    delay: float


FEET = (250, 303)
COPIES = (Copy((438, 264), 0.62, 2), Copy((566, 312), 0.45, 4))


def outline(outlines: dict[int, list[tuple[int, int]]], frame: int) -> np.ndarray:
    """The corners at a frame, linear between those given."""
    corners = np.array(list(outlines.values()), np.float64).transpose(1, 2, 0)
    return np.stack([[np.interp(frame, list(outlines), one) for one in corner] for corner in corners])


def make_mask(picture: np.ndarray, frame: int) -> np.ndarray:
    """The rabbit in one frame: bool (height, width)."""
    body = _filled(outline(BODY, frame))
    ears = _filled(outline(LEFT_EAR, frame)) | _filled(outline(RIGHT_EAR, frame))
    inside = cv2.erode(body, _disc(BODY_OFF[0])) | cv2.erode(ears, _disc(EARS_OFF[0]))
    reach = cv2.dilate(body, _disc(BODY_OFF[1])) | cv2.dilate(ears, _disc(EARS_OFF[1]))
    known = [inside > 0, (body | ears) > 0, reach > 0]
    label = np.select(known, [cv2.GC_FGD, cv2.GC_PR_FGD, cv2.GC_PR_BGD], cv2.GC_BGD).astype(np.uint8)
    dark = cv2.medianBlur(picture.max(-1), 5) < DARK
    label[:DARK_ROWS][dark[:DARK_ROWS]] = cv2.GC_BGD
    cv2.grabCut(picture, label, None, np.zeros((1, 65)), np.zeros((1, 65)), 4, cv2.GC_INIT_WITH_MASK)
    found = np.isin(label, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8) | cv2.erode(ears, _disc(2))
    found = cv2.morphologyEx(found, cv2.MORPH_OPEN, _disc(2))
    _, parts, sizes, _ = cv2.connectedComponentsWithStats(found)
    largest = 1 + sizes[1:, cv2.CC_STAT_AREA].argmax()
    return cv2.morphologyEx((parts == largest).astype(np.uint8), cv2.MORPH_CLOSE, _disc(3)) > 0


def _filled(corners: np.ndarray) -> np.ndarray:
    mask = np.zeros(SIZE, np.uint8)
    cv2.fillPoly(mask, [corners.round().astype(np.int32)], 1)
    return mask


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def multiplied(model: VideoModel, masks: np.ndarray) -> EditedVideo:
    """The model with copies of the rabbit in front of it."""
    grown = np.stack([cv2.dilate(mask.astype(np.uint8), _disc(GROWN)) > 0 for mask in masks])
    alone = edit(model).select(~by_mask(model, masks)).vanish()
    for limit, within in ((masks, WITHIN), (grown, WITHIN_GROWN)):
        alone = alone.select(
            lambda video, limit=limit, within=within: ~by_mask(video, limit, threshold=within, follow=False)
        ).vanish()
    step = 1 / (model.num_frames - 1)
    copies = alone.select().multiply(
        [np.subtract(copy.feet, FEET) / max(SIZE) for copy in COPIES],
        delays=[step * copy.delay for copy in COPIES],
        scale=[copy.scale for copy in COPIES],
        about=(np.array(FEET) - np.array(SIZE[::-1]) / 2) / max(SIZE),
    )
    return layers(copies.video(), model)


def pictures(frames: np.ndarray, model: VideoModel, edited: EditedVideo) -> list[np.ndarray]:
    """The frames of the animation: clip and model above, the edited video below."""
    numbers = np.arange(SLOWDOWN * FIRST, SLOWDOWN * (len(frames) - 1) + 1) / SLOWDOWN
    times = np.interp(numbers, np.arange(len(frames)), np.asarray(model.frame_times.times()))
    shown = []
    for count, (slow, below) in enumerate(zip(model.frames(times), edited.frames(times), strict=True)):
        clip = frames[FIRST + count % (len(frames) - FIRST)]
        above = [
            _labeled(cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), text)
            for picture, text in ((clip, "original"), (slow, "model, 1/4 speed"))
        ]
        gap = np.full((above[0].shape[0], 4, 3), 255, np.uint8)
        line = np.concatenate([above[0][:, :-2], gap, above[1][:, 2:]], 1)
        between = np.full((4, line.shape[1], 3), 255, np.uint8)
        shown.append(np.concatenate([line, between, _labeled(below, "model, edited: rabbit copied twice")]))
    return shown


def _labeled(picture: np.ndarray, text: str) -> np.ndarray:
    image = Image.fromarray(picture)
    font = ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans-Bold.ttf", 18)
    place = 8, picture.shape[0] - 28
    ImageDraw.Draw(image).text(place, text, "white", font, stroke_width=2, stroke_fill="black")
    return np.asarray(image)


def fitted(clip: Clip, folder: Path | None, runs: _runs.Runs) -> VideoModel:
    """The model that is in the folder, or a fit with the default settings, whose figures are added to the runs."""
    path = None if folder is None else folder / "animation.safetensors"
    if path is not None and path.exists():
        return load_video_model(path)
    model, run = _runs.fitted(clip, FitConfig(), cpu_time=True)
    runs.get("default", lambda: run)
    if path is not None:
        folder.mkdir(parents=True, exist_ok=True)
        save_video_model(path, model)
    return model


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/bunny.webp"), metavar="FILE", help="[docs/bunny.webp]")
    parser.add_argument("--models", type=Path, metavar="FOLDER", help="keep the model there, or take it from there")
    parser.add_argument("--still", type=Path, metavar="FILE", help="one frame of the animation")
    options = _common.parse(parser, arguments)
    clip = bunny(frames=FRAMES, size=SIZE)
    runs = _runs.Runs(options.json, {"frames": FRAMES, "size": SIZE})
    model = fitted(clip, options.models, runs)
    masks = np.stack([make_mask(picture, frame) for frame, picture in enumerate(clip.frames)])
    images = [Image.fromarray(picture) for picture in pictures(clip.frames, model, multiplied(model, masks))]
    with atomic_path(options.out) as temporary:
        first, *others = images
        first.save(
            temporary,
            "WEBP",
            save_all=True,
            append_images=others,
            duration=MILLISECONDS,
            loop=0,
            kmax=1,
            quality=QUALITY,
            method=4,
        )
    if options.still is not None:
        images[len(images) // 2].save(options.still)
    _common.console.print(f"{options.out}: {options.out.stat().st_size:,} bytes, {len(images)} frames")


if __name__ == "__main__":
    main()
