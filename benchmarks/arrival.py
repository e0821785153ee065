"""A compact file as it arrives: PSNR against bytes, chunk by chunk, and what the chunks cost.

    python -m benchmarks.arrival MODEL.fgz CLIP [--json FILE]

Each row is the file cut off after a chunk, as `load_video_model` reads it. `seek`: the bytes of the header and of the
chunks that a reader needs for one time, on average over the clip. `one chunk`: the same model in a single chunk.
"""

import json
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _common
from foldgauss.io import load_compact, load_video_model, read_video
from foldgauss.io.models.compact import pack_compact
from foldgauss.io.models.video_model import read_metadata
from foldgauss.video import VideoModel, psnr
from foldgauss.video.compression.quantize import compute_columns, dequantize, quantize


def measure(path: Path, frames: np.ndarray) -> dict[str, Any]:
    """The rows of a file's prefixes, and the bytes of the file, of a seek, and of the model in one chunk."""
    data = path.read_bytes()
    begin = 20 + int.from_bytes(data[12:16], "little")
    header, rows = json.loads(data[20:begin]), []
    end = begin + sum(header["motion"]["streams"])
    times = np.linspace(0, 1, len(frames))
    seek, num = float(end), 0
    for chunk in header["chunks"]:
        size = sum(chunk["streams"])
        end, num = end + size, num + chunk["num_gaussians"]
        seek += size * np.mean((chunk["visible"][0] <= times) & (times <= chunk["visible"][1]))
        model = _load_cut(data[:end])
        found = np.mean([psnr(frame, image) for frame, image in zip(frames, model.frames(), strict=True)])
        rows.append({"bytes": end, "fraction": end / len(data), "num_gaussians": num, "psnr": float(found)})
    whole = load_compact(path)
    one = quantize(compute_columns(dequantize(whole)), whole.columns["class"], whole.rules)
    return {
        "model": path.name,
        "prefixes": rows,
        "bytes": len(data),
        "seek_bytes": round(seek),
        "one_chunk_bytes": len(pack_compact(one, read_metadata(path))),
    }


def _load_cut(data: bytes) -> VideoModel:
    with tempfile.NamedTemporaryFile(suffix=".fgz") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # chunks are missing
        file.write(data)
        file.flush()
        return load_video_model(file.name)


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("clip", type=Path)
    options = _common.parse(parser, arguments)
    found = measure(options.model, read_video(options.clip, size=load_video_model(options.model).size).frames)
    forms = {"bytes": ",", "fraction": ".1%", "num_gaussians": ",", "psnr": ".2f"}
    rows = ([format(row[name], form) for name, form in forms.items()] for row in found["prefixes"])
    _common.print_table(found["model"], ("cut off after", "of the file", "Gaussians", "PSNR (dB)"), rows)
    cost, seek = found["bytes"] / found["one_chunk_bytes"] - 1, found["seek_bytes"] / found["bytes"]
    figures = {"overhead of chunks": cost, "fraction of the file for one time": seek}
    _common.finish(options.json, figures, **found)


if __name__ == "__main__":
    main()
