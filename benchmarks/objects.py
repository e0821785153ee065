"""Objects: a clip fitted in layers beside the same clip without, at equal quality and processor time.

    python -m benchmarks.objects --clips FOLDER --masks FOLDER [--only NAME ...] [--frames N] [--size HxW]
                                 [--quality Q] [--minutes M] [--sheets FOLDER] [--json FILE]

Subfolders as of `benchmarks.moving_objects`. Of one core each, process time. For each clip:

- the whole clip: bytes and PSNR, with layers and without;
- the object's layer alone over green: PSNR against the clip inside the masks; intersection over union of alpha above a
  half and the masks, and the mean absolute difference in a band of 5 pixels;
- an edit, three copies at 0.7 of the size, against the same made from true pixels and masks over the same background:
  by layers, and by a selection with the same masks from the model without layers.

The sheets have, from left to right: the clip, the object over green, the background; the edit of true pixels, by
layers, and without layers.
"""

import time
from collections import deque
from pathlib import Path

import cv2
import numpy as np

from benchmarks import _common
from benchmarks._clips import ClipSource, folder_sources
from benchmarks.moving_objects import measure_overlap
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io import read_masks, write_image
from foldgauss.video import EditedVideo, FitConfig, VideoModel, by_mask, edit, evaluate, psnr, ssim
from foldgauss.video.fitting.loop import finish, fit_steps
from foldgauss.video.fitting.rate import count_bytes
from foldgauss.video.layered import LayerPlan, plan_layers, stack

GREEN = (0.0, 0.8, 0.0)
#: Width of the band around the edges of masks, in pixels.
BAND = 5
#: The copies: offsets in units of the longer side, and their scale about the center of the frame.
OFFSETS, SCALE = ((-0.25, 0.0), (0.05, -0.1), (0.25, 0.05)), 0.7


def fit_plans(plans: list[LayerPlan], fps: float) -> tuple[dict[str, VideoModel], int, float]:
    """The models by name, their bytes, and seconds of processor time."""
    models, size, begun = {}, 0, time.process_time()
    for plan in plans:
        state, _ = deque(fit_steps(plan.frames, plan.config, cuts=plan.cuts, clock=time.process_time), maxlen=1)[0]
        models[plan.name], quantized = finish(state, plan.frames, plan.config, fps)
        size += count_bytes(quantized)
    return models, size, time.process_time() - begun


def place_copies(frames: np.ndarray, masks: np.ndarray, background: np.ndarray) -> np.ndarray:
    """What the edit makes of true pixels: the copies over the clip's object over the background."""
    height, width = frames.shape[1:3]
    images = np.where(masks[..., None], frames, background).astype(np.float32)
    center = np.array([width - 1, height - 1]) / 2
    for x, y in reversed(OFFSETS):
        shift = center - SCALE * center + np.array([x, y]) * max(height, width)
        matrix = np.float32([[SCALE, 0, shift[0]], [0, SCALE, shift[1]]])
        for k in range(len(images)):
            alpha = np.float32(masks[k])
            pixels = cv2.GaussianBlur(np.dstack([frames[k] * alpha[..., None], 255 * alpha]), (0, 0), 0.35 / SCALE)
            own = cv2.warpAffine(pixels, matrix, (width, height), flags=cv2.INTER_LINEAR)
            images[k] = own[..., :3] + (1 - own[..., 3:] / 255) * images[k]
    return images.round().astype(np.uint8)


def multiply(chain, *, about=(0.0, 0.0)) -> EditedVideo | VideoModel:
    """The edit of a selection: the copies stand before the original."""
    return chain.to_front().multiply(OFFSETS, scale=SCALE, about=about).to_front().video()


def measure(source: ClipSource, options) -> dict[str, float]:
    clip = source.read()
    frames, size = clip.frames, clip.size
    masks = read_masks(options.masks / source.name)[: len(frames)]
    masks = np.stack([cv2.resize(np.uint8(one), size[::-1], interpolation=cv2.INTER_NEAREST) > 0 for one in masks])
    config = FitConfig(quality=options.quality, minutes=options.minutes)
    plans = plan_layers(frames, {"object": masks}, config)
    plain, plain_bytes, plain_seconds = fit_plans([LayerPlan("", frames, config)], clip.fps)
    layers, layer_bytes, layer_seconds = fit_plans(plans, clip.fps)
    video, shown = stack(layers), np.flatnonzero(masks.any((1, 2)))
    over_green = np.stack(list(layers["object"].frames(background=GREEN)))
    alpha = np.stack([image[..., 3] for image in layers["object"].frames(background=None)]) / 255
    kernel = np.ones((BAND, BAND), np.uint8)
    bands = np.stack([cv2.dilate(np.uint8(one), kernel) > cv2.erode(np.uint8(one), kernel) for one in masks])
    inside = [np.square(over_green[k][masks[k]] - frames[k][masks[k]].astype(float)).mean() for k in shown]
    true = place_copies(frames, masks, plans[-1].frames)
    edits = {
        "layers": multiply(edit(video).select(layer="object")),
        "no layers": multiply(edit(plain[""]).select(by_mask(plain[""], masks))),
    }
    images = {name: np.stack(list(one.frames())) for name, one in edits.items()}
    found = {
        "PSNR without layers": evaluate(plain[""], frames).mean_psnr,
        "bytes without layers": plain_bytes,
        "CPU seconds without layers": plain_seconds,
        "PSNR": evaluate(video, frames).mean_psnr,
        "bytes": layer_bytes,
        "CPU seconds": layer_seconds,
        "Gaussians without layers": plain[""].num_gaussians,
        "Gaussians": video.num_gaussians,
        "hidden": plans[-1].unknown,
        "object over green": float(np.mean([10 * np.log10(255**2 / one) for one in inside])),
        "IoU": float(measure_overlap(alpha > 0.5, masks)[shown].mean()),
        "band": float(np.mean([np.abs(alpha[k] - masks[k])[bands[k]].mean() for k in shown])),
    }
    for name, made in images.items():
        found[f"copies by {name}, PSNR"] = float(np.mean(list(map(psnr, true, made))))
        found[f"copies by {name}, SSIM"] = float(np.mean(list(map(ssim, true, made))))
    if options.sheets is not None:
        k = shown[len(shown) // 2]
        rows = [[frames[k], over_green[k], next(layers["background"].frames([plans_time(layers, k)]))]]
        rows.append([true[k], images["layers"][k], images["no layers"][k]])
        options.sheets.mkdir(parents=True, exist_ok=True)
        write_image(options.sheets / f"{source.name}.png", np.vstack([np.hstack(row) for row in rows]))
    return found


def plans_time(layers: dict[str, VideoModel], k: int) -> float:
    """The time of frame k, which all layers share."""
    return float(layers["background"].frame_times.times()[k])


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--clips", type=Path, required=True, metavar="FOLDER", help="its subfolders are clips")
    parser.add_argument("--masks", type=Path, required=True, metavar="FOLDER", help="its subfolders hold their masks")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these clips alone")
    parser.add_argument("--frames", type=int, default=40, metavar="N", help="the first N frames")
    parser.add_argument("--size", default="270x480", metavar="HxW", help="height x width of the frames")
    parser.add_argument("--quality", type=float, default=70.0, metavar="Q", help="of all fits")
    parser.add_argument("--minutes", type=float, default=2.0, metavar="M", help="of one core, for each fit of a clip")
    parser.add_argument("--sheets", type=Path, metavar="FOLDER", help="write pictures here")
    options = _common.parse(parser, arguments)
    set_num_threads(1)
    size = tuple(map(int, options.size.split("x")))
    sources = [one._replace(size=size, frames=options.frames) for one in folder_sources(options.clips)]
    sources = [one for one in sources if (options.masks / one.name).is_dir()]
    sources = [one for one in sources if one.name in (options.only or [one.name])]
    if not sources:
        raise SystemExit(f"--masks: expected masks of a clip in {options.clips}, {options.masks} has none.")
    rows, figures = [], {}
    for source in sources:
        one = measure(source, options)
        figures |= {f"{name} of {source.name}": value for name, value in one.items()}
        kept = [f"{one[f'PSNR{of}']:.2f} dB, {one[f'bytes{of}']:,.0f} B" for of in (" without layers", "")]
        edits = [
            f"{one[f'copies by {of}, PSNR']:.1f}, {one[f'copies by {of}, SSIM']:.3f}" for of in ("no layers", "layers")
        ]
        alone = f"{one['object over green']:.1f} dB", f"{one['IoU']:.3f}", f"{one['band']:.3f}", f"{one['hidden']:.0%}"
        rows.append((source.name, *kept, *alone, *edits))
    columns = ("clip", "without layers", "layers", "over green", "IoU", "band", "hidden", "copies without", "copies")
    _common.print_table("Objects with layers of their own", columns, rows)
    _common.finish(options.json, figures)


if __name__ == "__main__":
    main()
