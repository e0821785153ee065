"""Videos as folded splats: the model, its fit, edits and compression. Frames are arrays; `foldgauss.io` reads files.

In reading order: `models` (the model, and rendering it), `motion` (optical flow, the camera's path, `stabilize`),
`fitting` (`fit`), `selection` (`select`), `editing` (`edit`),
`segmented` (long videos in segments), `compression` (`compress`) and `tradeoff` (speed against accuracy).
"""

from foldgauss.video.editing.chain import Edit, edit
from foldgauss.video.editing.edited_video import EditedVideo, Layer
from foldgauss.video.editing.overlays import SelectedGaussians
from foldgauss.video.editing.timing import Clock, Span
from foldgauss.video.fitting.compress import compress
from foldgauss.video.fitting.config import FitConfig, Growth, LearningRates, Loss, Strategy, Views
from foldgauss.video.fitting.density_control import DensityControl
from foldgauss.video.fitting.divergence import DivergenceWarning, FitDiverged
from foldgauss.video.fitting.loop import FitInfo, FitResult, FitState, fit, fit_steps, start_from
from foldgauss.video.fitting.losses import register_loss
from foldgauss.video.layered import fit_layers
from foldgauss.video.models.density import density_image
from foldgauss.video.models.frame_times import (
    FrameTimes,
    interpolated_times,
    played_positions,
    remapped_positions,
    times_at,
)
from foldgauss.video.models.metrics import Evaluation, evaluate, psnr, ssim
from foldgauss.video.models.polynomial_folds import without_paths
from foldgauss.video.models.shared_paths import SharedPaths
from foldgauss.video.models.splats import FoldedSplats
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.motion.camera_path import CameraPath, estimate_camera_path
from foldgauss.video.motion.followed_object import follow_object
from foldgauss.video.motion.layer_clips import separate
from foldgauss.video.motion.moving_object import NothingMoves, find_moving_object
from foldgauss.video.motion.slow_motion import interpolate_frames
from foldgauss.video.motion.stabilization import StabilizedVideo, stabilize
from foldgauss.video.segmented.layering import layers
from foldgauss.video.segmented.segmented_edit import SegmentedEdit
from foldgauss.video.segmented.segmented_video import Segment, SegmentedVideo, plan_segments
from foldgauss.video.selection.selectors import (
    Selection,
    by_box,
    by_click,
    by_color,
    by_mask,
    by_motion,
    by_polygon,
    by_time,
    contribution,
    influence,
    matte,
    select,
)

__all__ = [
    "CameraPath",
    "Clock",
    "DensityControl",
    "DivergenceWarning",
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
    "Layer",
    "LearningRates",
    "Loss",
    "NothingMoves",
    "Segment",
    "SegmentedEdit",
    "SegmentedVideo",
    "SelectedGaussians",
    "Selection",
    "SharedPaths",
    "Span",
    "StabilizedVideo",
    "Strategy",
    "VideoModel",
    "Views",
    "by_box",
    "by_click",
    "by_color",
    "by_mask",
    "by_motion",
    "by_polygon",
    "by_time",
    "compress",
    "contribution",
    "density_image",
    "edit",
    "estimate_camera_path",
    "evaluate",
    "find_moving_object",
    "fit",
    "fit_layers",
    "fit_steps",
    "follow_object",
    "influence",
    "interpolate_frames",
    "interpolated_times",
    "layers",
    "matte",
    "plan_segments",
    "played_positions",
    "psnr",
    "register_loss",
    "remapped_positions",
    "select",
    "separate",
    "ssim",
    "stabilize",
    "start_from",
    "times_at",
    "without_paths",
]
