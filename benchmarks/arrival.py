"""A compact file as it arrives: PSNR against bytes, chunk by chunk, and what the chunks cost.

    python -m benchmarks.arrival MODEL.fgz CLIP [--json FILE] [--figure FILE]

Each row is the file cut off after a chunk, as `load_video_model` reads it. `seek`: the bytes of the header and of the
chunks that a reader needs for the frame in the middle of the clip. `one chunk`: the same model in a single chunk.
"""

import argparse
import json
import tempfile
import warnings
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks import _common
from benchmarks._common import console
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
    seek, num = end, 0
    for chunk in header["chunks"]:
        size = sum(chunk["streams"])
        end, num = end + size, num + chunk["num_gaussians"]
        seek += size * (chunk["visible"][0] <= 0.5 <= chunk["visible"][1])
        model = _load_cut(data[:end])
        found = np.mean([psnr(frame, image) for frame, image in zip(frames, model.frames(), strict=True)])
        rows.append({"bytes": end, "fraction": end / len(data), "num_gaussians": num, "psnr": float(found)})
    whole = load_compact(path)
    one = quantize(compute_columns(dequantize(whole)), whole.columns["class"], whole.rules)
    return {
        "model": path.name,
        "prefixes": rows,
        "bytes": len(data),
        "seek_bytes": seek,
        "one_chunk_bytes": len(pack_compact(one, read_metadata(path))),
    }


def _load_cut(data: bytes) -> VideoModel:
    with tempfile.NamedTemporaryFile(suffix=".fgz") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # chunks are missing
        file.write(data)
        file.flush()
        return load_video_model(file.name)


def draw(found: dict[str, Any], path: Path) -> None:
    """PSNR against bytes."""
    figure, axes = plt.subplots(figsize=(5.2, 3.4), layout="constrained")
    rows = found["prefixes"]
    axes.plot([row["bytes"] / 1e3 for row in rows], [row["psnr"] for row in rows], "o-")
    axes.set(xlabel="kB of the file", ylabel="PSNR (dB)", title=found["model"])
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args(argv)
    frames = read_video(args.clip, size=load_video_model(args.model).size).frames
    found = measure(args.model, frames)
    for row in found["prefixes"]:
        console.print("{bytes:10,} bytes {fraction:7.1%} {num_gaussians:9,} Gaussians {psnr:6.2f} dB".format(**row))
    cost = found["bytes"] / found["one_chunk_bytes"] - 1
    console.print(f"one chunk: {found['one_chunk_bytes']:,} bytes; the chunks cost {cost:.1%}")
    console.print(f"seek to the middle: {found['seek_bytes'] / found['bytes']:.1%} of the bytes")
    if args.json:
        _common.write_json(args.json, found)
    if args.figure:
        draw(found, args.figure)


if __name__ == "__main__":
    main()
