"""Videos as folded splats: the model, its fit and its quality. Frames are arrays here; files are `foldgauss.io`'s."""

from foldgauss.video.config import FitConfig, LearningRates
from foldgauss.video.density import density_image
from foldgauss.video.fit import FitInfo, FitResult, FitState, fit, fit_steps
from foldgauss.video.frame_times import FrameTimes, interpolated_times, played_positions, remapped_positions, times_at
from foldgauss.video.growth import Growth
from foldgauss.video.metrics import Evaluation, evaluate, psnr, ssim
from foldgauss.video.model import FoldedSplats, VideoModel

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
    "VideoModel",
    "density_image",
    "evaluate",
    "fit",
    "fit_steps",
    "interpolated_times",
    "played_positions",
    "psnr",
    "remapped_positions",
    "ssim",
    "times_at",
]
