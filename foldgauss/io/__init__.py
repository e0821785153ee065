"""Reading and writing files; every output appears whole or not at all.

Clips, images and masks (`read_video`, `write_video`, `index_video`, `read_masks`), models (`save_video_model`,
`load_video_model`, `save_compact`), formats of other programs (`write_vegas_ply`, `write_3dgs_frames`,
`write_pseudomesh`), the HTML player (`write_html`), scripts of edits (`read_edit_script`), and the history of a fit.
Sample clips: `foldgauss.io.datasets`.
"""

from foldgauss.io._atomic import OutputError
from foldgauss.io.edit_script import EditScript, EditScriptError, read_edit_script
from foldgauss.io.exchange.gaussians_ply import (
    frame_gaussians,
    read_3dgs_ply,
    write_3dgs_frames,
    write_3dgs_ply,
    write_gaussians_ply,
)
from foldgauss.io.exchange.ply_file import FormatError
from foldgauss.io.exchange.pseudomesh import write_pseudomesh
from foldgauss.io.exchange.vegas_ply import read_vegas_ply, write_vegas_ply, write_vegas_segments
from foldgauss.io.history import HistoryFile, read_history, write_curves
from foldgauss.io.media.clip import Clip, VideoError
from foldgauss.io.media.indexing import FrameIndex, LazyFrames, index_video, read_indexed
from foldgauss.io.media.masks import read_masks
from foldgauss.io.media.reading import read_video
from foldgauss.io.media.writing import Sound, write_frames, write_image, write_video
from foldgauss.io.models.compact import load_compact, save_compact
from foldgauss.io.models.model_file import ModelFileError
from foldgauss.io.models.segmented import join_segments
from foldgauss.io.models.selections import format_indices, parse_indices
from foldgauss.io.models.video_model import load_video_model, save_video_model
from foldgauss.io.page.player_page import html_page, write_html

__all__ = [
    "Clip",
    "EditScript",
    "EditScriptError",
    "FormatError",
    "FrameIndex",
    "HistoryFile",
    "LazyFrames",
    "ModelFileError",
    "OutputError",
    "Sound",
    "VideoError",
    "format_indices",
    "frame_gaussians",
    "html_page",
    "index_video",
    "join_segments",
    "load_compact",
    "load_video_model",
    "parse_indices",
    "read_3dgs_ply",
    "read_edit_script",
    "read_history",
    "read_indexed",
    "read_masks",
    "read_vegas_ply",
    "read_video",
    "save_compact",
    "save_video_model",
    "write_3dgs_frames",
    "write_3dgs_ply",
    "write_curves",
    "write_frames",
    "write_gaussians_ply",
    "write_html",
    "write_image",
    "write_pseudomesh",
    "write_vegas_ply",
    "write_vegas_segments",
    "write_video",
]
