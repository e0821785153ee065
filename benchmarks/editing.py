"""Objects edited: how well they are told apart, and what edits leave, with contact sheets to look at.

    python -m benchmarks.editing [--json FILE] [--sheets FOLDER] [--clip rider|shapes ...] [--gaussians N] [--steps N]
                                 [--models FOLDER]

*rider*: 25 frames of *bikes* at 160x384, a man who rides past cars. His masks are made here, by a rough outline on five
frames and by color (GrabCut) on all. *shapes*: 24 frames of 128x256 made here, a striped disc and a chequered box over
a textured ground; masks and the picture behind the disc are known.

Each is fitted, its object selected by its masks and then deleted, copied, made smaller or larger, and changed in one
frame. With `--sheets` each clip gives a PNG: rows are the original, the selection, the edits; columns are times.
`--models` keeps the fitted models, and takes those that are there.

Figures:

- `iou`: of the object in the picture, which is where the selection makes up more than half, with the masks, all frames
  together; `iou_few`: when it is selected by the masks of a few frames alone (5 and 3), over the other frames.
- `left`: how much of the object the picture without it still shows: the difference from the picture behind, projected
  on that of the original, over the masks; 0 is nothing, 1 all. What is behind the rider is taken from the nearest
  frames that show it.
- `single_inside`, `single_outside`: PSNR against the clip of the one edited frame, less before the edit: within the
  masks, and beyond the pixels that the object reaches before or after. `single_others`: largest difference in all
  other frames.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image

from benchmarks import _common
from foldgauss.io import load_video_model, save_video_model
from foldgauss.io.datasets import bikes
from foldgauss.video import (
    Edit,
    EditedVideo,
    FitConfig,
    Selection,
    VideoModel,
    by_mask,
    edit,
    evaluate,
    fit,
    influence,
    layers,
    matte,
)

# fmt: off
#: Outlines of the rider, (x, y) at 160x384: rough, within some pixels. He leaves to the right.
OUTLINES = {
    0: [(152, -3), (150, 22), (156, 38), (118, 49), (100, 100), (99, 120), (102, 140), (112, 163), (232, 163),
        (230, 115), (212, 60), (186, 47), (191, 15), (188, -3)],
    6: [(216, -3), (214, 22), (220, 36), (172, 45), (156, 95), (153, 120), (157, 145), (164, 163), (294, 163),
        (290, 135), (273, 60), (248, 47), (254, 18), (250, -3)],
    12: [(314, -3), (311, 22), (313, 34), (268, 42), (255, 85), (240, 125), (218, 163), (260, 163), (392, 163),
        (382, 115), (370, 64), (350, 50), (356, 20), (352, -3)],
    16: [(405, -3), (402, 22), (395, 38), (353, 42), (340, 85), (326, 140), (318, 163), (360, 163), (492, 163),
        (482, 115), (470, 64), (450, 50), (456, 20), (450, -3)],
    19: [(480, -3), (477, 22), (470, 38), (428, 42), (415, 85), (401, 140), (393, 163), (435, 163), (567, 163),
        (557, 115), (545, 64), (525, 50), (531, 20), (525, -3)],
}
# fmt: on
#: Pixels that a rough outline may be off.
ROUGH = 10
#: Columns that he crosses, and a frame at which he is past them, and the taxi that follows not yet there.
PAST = {(0, 205): 12, (205, 384): 20}
#: Share of what a Gaussian of an object alone adds that has to lie in its masks.
WITHIN = 0.7
#: A mask is grown by so many pixels before it is said what is seen beside it.
BESIDE = 5
CYAN = (0.0, 220.0, 255.0)
MAGENTA = (255.0, 0.0, 255.0)
#: Largest size of a sheet's file, in bytes; the sheet is scaled down until it fits.
SHEET_BYTES = 400_000
#: Width of a sheet at most, in pixels.
SHEET_WIDTH = 1280
#: Colors of a sheet.
COLORS = 200

Video = VideoModel | EditedVideo


class Scene(NamedTuple):
    """A clip with one object. `behind`: the frames without it, as far as they are known."""

    name: str
    frames: np.ndarray  # uint8 (num_frames, height, width, 3)
    masks: np.ndarray  # bool (num_frames, height, width)
    behind: np.ndarray  # like frames
    fps: float
    shown: tuple[int, ...]  # frames of the sheet; the second is the one edited alone
    few: tuple[int, ...]  # frames whose masks select the object in `iou_few`
    edits: dict[str, Callable[[VideoModel, Selection], Video]]
    tint: tuple[float, float, float]  # of the selection, in the sheet
    brightness: float = 1.0  # of the sheet

    @property
    def single(self) -> int:
        return self.shown[1]


def rider() -> Scene:
    clip = bikes(frames=(30, 55), size=(160, 384))
    masks = np.stack([_cut_out(frame, _outline(k)) for k, frame in enumerate(clip.frames)])
    beside = np.stack([_grown(mask, BESIDE) for mask in masks])
    shown, edits = (3, 7, 10, 13), RiderEdits(masks, beside.any(0))
    made = {"vanish": edits.gone, "multiply": edits.three, "scale": edits.smaller, "single frame": edits.red(shown[1])}
    few = (0, 4, 8, 12, 16)
    return Scene("rider", clip.frames, masks, _seen_beside(clip.frames, beside), clip.fps, shown, few, made, CYAN, 1.6)


def alone(model: VideoModel, it: Selection, masks: np.ndarray) -> Edit:
    """The object without anything else, for a layer; nor what others used to hide, beyond the masks."""
    cut = edit(model).select(~it).vanish()
    return cut.select(lambda video: ~by_mask(video, masks, threshold=WITHIN, follow=False)).vanish().select()


class RiderEdits:
    """What he rides past was never seen while he hid it, so where he `crossed` it stands still as it is after him.

    He himself becomes a layer in front: cars that stand before him in array order would cover his copies.
    """

    def __init__(self, masks: np.ndarray, crossed: np.ndarray):
        self._masks, self._crossed = masks, crossed

    def gone(self, model: VideoModel, it: Selection) -> Video:
        gone = edit(model).select(it).vanish()
        for (first, stop), frame in PAST.items():
            crossed = np.zeros_like(self._crossed)
            crossed[:, first:stop] = self._crossed[:, first:stop]
            hidden = by_mask(model, crossed, frames=(0, model.num_frames)) - it
            gone = gone.select(hidden).freeze(frame)
        return gone.video()

    def three(self, model: VideoModel, it: Selection) -> Video:
        copies = alone(model, it, self._masks).multiply([(-0.34, 0.0), (0.34, 0.0)], delays=[0.04, 0.0])
        return layers(copies.video(), self.gone(model, it))

    def smaller(self, model: VideoModel, it: Selection) -> Video:
        return layers(
            alone(model, it, self._masks).scale(0.6, about=(0.0, 160 / 384 / 2)).video(), self.gone(model, it)
        )

    def red(self, frame: int) -> Callable[[VideoModel, Selection], Video]:
        return lambda model, it: edit(model).select(it).recolor((0.8, 0.1, 0.1), frame=frame).video()


def _outline(k: int) -> np.ndarray:
    """Between the frames with an outline, corners go straight; beyond the last there is none."""
    numbers, corners = list(OUTLINES), np.array(list(OUTLINES.values()), np.float64)
    if k > numbers[-1]:
        return np.empty((0, 2))
    return np.stack([[np.interp(k, numbers, one) for one in corner.T] for corner in corners.transpose(1, 0, 2)])


def _cut_out(frame: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """What a rough outline means, by color: bool (height, width)."""
    drawn = np.zeros(frame.shape[:2], np.uint8)
    if len(outline):
        cv2.fillPoly(drawn, [outline.round().astype(np.int32)], 1)
    if not drawn.any():
        return drawn.astype(bool)
    square = np.ones((2 * ROUGH + 1, 2 * ROUGH + 1))
    surely, perhaps = cv2.erode(drawn, square, borderValue=1), cv2.dilate(drawn, square)
    label = np.select([surely > 0, drawn > 0, perhaps > 0], [cv2.GC_FGD, cv2.GC_PR_FGD, cv2.GC_PR_BGD], cv2.GC_BGD)
    label = label.astype(np.uint8)
    cv2.grabCut(frame, label, None, np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
    return (label == cv2.GC_FGD) | (label == cv2.GC_PR_FGD)


def _grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * pixels + 1, 2 * pixels + 1))) > 0


def _seen_beside(frames: np.ndarray, masks: np.ndarray) -> np.ndarray:
    """Frames without the masked: each pixel as in the nearest frame where it is not masked."""
    number = np.arange(len(frames))
    filled = frames.copy()
    for k in number:
        for other in sorted(number, key=lambda one: -abs(one - k)):  # the nearest is written last
            seen = masks[k] & ~masks[other]
            filled[k][seen] = frames[other][seen]
    return filled


def shapes(num_frames: int = 24, size: tuple[int, int] = (128, 256)) -> Scene:
    height, width = size
    y, x = np.mgrid[0:height, 0:width] + 0.5
    ground = 0.45 + 0.12 * np.sin(x / 9) * np.cos(y / 12) + 0.08 * np.sin((x + 2 * y) / 7)
    ground = np.stack([0.5 * ground, ground, 0.6 * ground], -1)
    frames, behind, masks = [], [], []
    for t in np.linspace(0, 1, num_frames):
        u, v = x - (0.78 - 0.12 * t) * width, y - (0.62 - 0.2 * t) * height
        chequer = 0.75 + 0.2 * np.sign(np.sin(u / 4) * np.sin(v / 4))
        box = np.maximum(np.abs(u), np.abs(v)) < 0.17 * height
        picture = np.where(box[..., None], np.stack([0.25 * chequer, 0.35 * chequer, chequer], -1), ground)
        u, v = x - (0.15 + 0.7 * t) * width, y - (0.36 + 0.3 * t**2) * height
        stripe = 0.75 + 0.2 * np.sin((u + v) / 4)
        disc = u**2 + v**2 < (0.2 * height) ** 2
        behind.append(picture)
        frames.append(np.where(disc[..., None], np.stack([stripe, 0.35 * stripe, 0.15 * stripe], -1), picture))
        masks.append(disc)
    masks = np.stack(masks)
    frames, behind = ((255 * np.stack(one)).round().clip(0, 255).astype(np.uint8) for one in (frames, behind))
    shown = (3, 9, 15, 20)
    edits = {
        "vanish": lambda model, it: edit(model).select(it).vanish().video(),
        "multiply": lambda model, it: layers(
            alone(model, it, masks)
            .multiply([(0.0, 0.14), (0.0, 0.28)], delays=[0.1, 0.2], scale=0.7, originals=True)
            .video(),
            edit(model).select(it).vanish().video(),
        ),
        "scale": lambda model, it: layers(
            alone(model, it, masks).scale(1.6).video(), edit(model).select(it).vanish().video()
        ),
        "single frame": lambda model, it: edit(model).select(it).recolor(hue=0.8, frame=shown[1]).video(),
    }
    return Scene("shapes", frames, masks, behind, 24.0, shown, (2, 11, 21), edits, MAGENTA)


SCENES = {"rider": rider, "shapes": shapes}


def fitted(scene: Scene, config: FitConfig, folder: Path | None) -> VideoModel:
    path = None if folder is None else folder / f"{scene.name}.safetensors"
    if path is not None and path.exists():
        return load_video_model(path)
    model = fit(scene.frames, config, fps=scene.fps).model
    if path is not None:
        save_video_model(path, model)
    return model


def iou(model: VideoModel, it: Selection, masks: np.ndarray, numbers: list[int]) -> float:
    times = np.asarray(model.frame_times.times())
    shown = np.stack([matte(model, it, float(times[k])) > 0.5 for k in numbers])
    truth = masks[numbers]
    return float((shown & truth).sum() / (shown | truth).sum())


def left_of(scene: Scene, before: np.ndarray, after: np.ndarray) -> float:
    """Share of the object that the pictures after the edit still show, see the module's docstring."""
    was, still = (pictures.astype(np.float64) - scene.behind for pictures in (before, after))
    return float((was * still)[scene.masks].sum() / (was * was)[scene.masks].sum())


def psnr_in(picture: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    error = np.mean((picture.astype(np.float64) - truth)[where] ** 2)
    return float(10 * np.log10(255**2 / max(error, 1e-12)))


def single_frame(scene: Scene, model: VideoModel, it: Selection, before: np.ndarray, edited: EditedVideo) -> dict:
    """Figures of the edit of one frame."""
    k, after = scene.single, np.stack(list(edited.frames()))
    reached = influence(model, it, float(model.frame_times.times()[k]))
    change = {
        f"single_{name}": psnr_in(after[k], scene.frames[k], where) - psnr_in(before[k], scene.frames[k], where)
        for name, where in (("inside", scene.masks[k]), ("outside", ~reached))
    }
    others = np.delete(np.arange(len(after)), k)
    return change | {"single_others": float(np.abs(after[others].astype(int) - before[others]).max())}


def measured(scene: Scene, model: VideoModel) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Figures, and the pictures of the sheet's rows."""
    it = by_mask(model, scene.masks)
    few = by_mask(model, {k: scene.masks[k] for k in scene.few})
    everywhere = [k for k in range(len(scene.masks)) if scene.masks[k].any()]
    before, times = np.stack(list(model.frames())), np.asarray(model.frame_times.times())
    videos = {name: make(model, it) for name, make in scene.edits.items()}
    after = np.stack(list(videos["vanish"].frames()))
    figures = {
        "psnr": evaluate(model, scene.frames).mean_psnr,
        "gaussians": model.num_gaussians,
        "selected": len(it),
        "iou": iou(model, it, scene.masks, everywhere),
        "iou_few": iou(model, few, scene.masks, [k for k in everywhere if k not in scene.few]),
        "left": left_of(scene, before, after),
        **single_frame(scene, model, it, before, videos["single frame"]),
    }
    share = np.stack([matte(model, it, float(times[k])) for k in scene.shown])[..., None]
    numbers = list(scene.shown)
    bright = {"original": scene.frames[numbers], "selected": before[numbers]}
    bright |= {name: np.stack(list(video.frames(times[numbers]))) for name, video in videos.items()}
    rows = {name: scene.brightness * pictures for name, pictures in bright.items()}
    rows["selected"] = rows["selected"] * (1 - 0.6 * share) + np.array(scene.tint) * 0.6 * share
    return figures, rows


def sheet(rows: dict[str, np.ndarray]) -> np.ndarray:
    """One picture of all: rows of pictures, with their names."""
    lines = []
    for name, pictures in rows.items():
        line = np.ascontiguousarray(np.concatenate(list(pictures), axis=1).round().clip(0, 255).astype(np.uint8))
        for color, thickness in (((0, 0, 0), 4), ((255, 255, 255), 1)):
            cv2.putText(line, name, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, color, thickness, cv2.LINE_AA)
        lines.append(line)
    return np.concatenate(lines)


def write_sheet(path: Path, picture: np.ndarray) -> None:
    """As large as the file's size allows."""
    width = min(SHEET_WIDTH, picture.shape[1])
    while True:
        height = round(width * picture.shape[0] / picture.shape[1])
        small = Image.fromarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))
        small.quantize(COLORS, dither=Image.Dither.NONE).save(path, optimize=True)
        if path.stat().st_size <= SHEET_BYTES:
            return
        width = int(0.9 * width)


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--clip", choices=tuple(SCENES), action="append", help="[both]")
    parser.add_argument("--gaussians", type=_common.whole, default=20_000, help="[20000]")
    parser.add_argument("--steps", type=_common.whole, default=1_500, help="[1500]")
    parser.add_argument("--sheets", type=Path, metavar="FOLDER", help="write contact sheets to FOLDER")
    parser.add_argument("--models", type=Path, metavar="FOLDER", help="keep models there, and take those there are")
    options = _common.parse(parser, arguments)
    for folder in (options.sheets, options.models):
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
    config, found = FitConfig(num_gaussians=options.gaussians, steps=options.steps), {}
    for name in options.clip or list(SCENES):
        scene = SCENES[name]()
        found[name], rows = measured(scene, fitted(scene, config, options.models))
        if options.sheets is not None:
            write_sheet(options.sheets / f"editing-{name}.png", sheet(rows))
    names = next(iter(found.values()))
    rows = ((name, *(f"{figures[name]:,.4g}" for figures in found.values())) for name in names)
    _common.print_table("Objects edited", ("figure", *found), rows)
    figures = {f"{clip}_{name}": value for clip, own in found.items() for name, value in own.items()}
    _common.finish(options.json, figures, gaussians=options.gaussians, steps=options.steps)


if __name__ == "__main__":
    main()
