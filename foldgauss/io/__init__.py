"""Files: clips in and out, model files, pictures. Every output appears whole or not at all."""

from foldgauss.io._atomic import OutputError
from foldgauss.io.history import HistoryFile, read_history, write_curves
from foldgauss.io.masks import read_masks
from foldgauss.io.model_file import ModelFileError
from foldgauss.io.selections import load_selection, save_selection
from foldgauss.io.video_file import Clip, VideoError, read_video, write_image, write_video
from foldgauss.io.video_model import load_video_model, save_video_model

__all__ = [
    "Clip",
    "HistoryFile",
    "ModelFileError",
    "OutputError",
    "VideoError",
    "load_selection",
    "load_video_model",
    "read_history",
    "read_masks",
    "read_video",
    "save_selection",
    "save_video_model",
    "write_curves",
    "write_image",
    "write_video",
]
