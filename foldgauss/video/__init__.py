"""Videos as folded splats: the model, its fit and its quality. Frames are arrays here; files are `foldgauss.io`'s."""

from foldgauss.video.config import FitConfig, LearningRates
from foldgauss.video.density import density_image
from foldgauss.video.fit import FitInfo, FitResult, FitState, fit, fit_steps
from foldgauss.video.frame_times import FrameTimes, interpolated_times, played_positions, remapped_positions, times_at
from foldgauss.video.growth import Growth
from foldgauss.video.metrics import Evaluation, evaluate, psnr, ssim
from foldgauss.video.model import FoldedSplats, VideoModel
from foldgauss.video.select import (
    Selection,
    by_box,
    by_click,
    by_color,
    by_mask,
    by_polygon,
    by_time,
    contribution,
    influence,
    matte,
    select,
)

__all__ = [
    "Evaluation",
    "FitConfig",
    "FitInfo",
    "FitResult",
    "FitState",
    "FoldedSplats",
    "FrameTimes",
    "Growth",
    "LearningRates",
    "Selection",
    "VideoModel",
    "by_box",
    "by_click",
    "by_color",
    "by_mask",
    "by_polygon",
    "by_time",
    "contribution",
    "density_image",
    "evaluate",
    "fit",
    "fit_steps",
    "influence",
    "interpolated_times",
    "matte",
    "played_positions",
    "psnr",
    "remapped_positions",
    "select",
    "ssim",
    "times_at",
]
