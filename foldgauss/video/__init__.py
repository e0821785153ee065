"""Videos as folded splats: the model, its fit and its quality. Frames are arrays here; files are `foldgauss.io`'s."""

from foldgauss.video.compress import Compressed, compress
from foldgauss.video.config import FitConfig, LearningRates
from foldgauss.video.density import density_image
from foldgauss.video.economy import Economy
from foldgauss.video.edit import Edit, edit
from foldgauss.video.edited import EditedVideo, Layer
from foldgauss.video.fit import FitInfo, FitResult, FitState, fit, fit_steps, start_from
from foldgauss.video.frame_times import FrameTimes, interpolated_times, played_positions, remapped_positions, times_at
from foldgauss.video.growth import Growth
from foldgauss.video.guard import DivergenceWarning, FitDiverged
from foldgauss.video.independent import IndependentFrames, independent_frames
from foldgauss.video.metrics import Evaluation, evaluate, psnr, ssim
from foldgauss.video.model import FoldedSplats, VideoModel
from foldgauss.video.overlays import SelectedGaussians
from foldgauss.video.segment_edits import SegmentedEdit, SegmentedSelection
from foldgauss.video.segment_layers import layers
from foldgauss.video.segments import Segment, SegmentedVideo, plan_segments
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
from foldgauss.video.timing import Clock, Span

__all__ = [
    "Clock",
    "Compressed",
    "DivergenceWarning",
    "Economy",
    "Edit",
    "EditedVideo",
    "Evaluation",
    "FitConfig",
    "FitDiverged",
    "FitInfo",
    "FitResult",
    "FitState",
    "FoldedSplats",
    "FrameTimes",
    "Growth",
    "IndependentFrames",
    "Layer",
    "LearningRates",
    "Segment",
    "SegmentedEdit",
    "SegmentedSelection",
    "SegmentedVideo",
    "SelectedGaussians",
    "Selection",
    "Span",
    "VideoModel",
    "by_box",
    "by_click",
    "by_color",
    "by_mask",
    "by_polygon",
    "by_time",
    "compress",
    "contribution",
    "density_image",
    "edit",
    "evaluate",
    "fit",
    "fit_steps",
    "independent_frames",
    "influence",
    "interpolated_times",
    "layers",
    "matte",
    "plan_segments",
    "played_positions",
    "psnr",
    "remapped_positions",
    "select",
    "ssim",
    "start_from",
    "times_at",
]
