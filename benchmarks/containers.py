"""What becomes of forty kinds of video files: read by foldgauss, by OpenCV, and as ffprobe counts them.

    python -m benchmarks.containers [--json FILE] [--before FILE]

Each file is made with ffmpeg from the same 12 frames of 48x64 at 10 a second. The table says how many frames were read,
at which rate, and the largest mean error of a frame in levels against the frames encoded; a refusal by its first words.
`--before`: the JSON of another version's run, shown beside.
"""

import argparse
import json
import shutil
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks import _common
from benchmarks._common import console
from foldgauss.io import VideoError, read_video

NUM, HEIGHT, WIDTH, RATE = 12, 48, 64, 10
_X264 = ("-c:v", "libx264", "-crf", "5")
_UNEVEN = ("-vf", "setpts='PTS+3*gt(N,5)/10/TB'", "-vsync", "vfr")
_SOUND = ("-f", "lavfi", "-i", "sine=d=3")
#: Name, extension, ffmpeg's options.
KINDS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("H.264", ".mp4", (*_X264, "-pix_fmt", "yuv420p")),
    ("H.264, 4:4:4", ".mp4", (*_X264, "-pix_fmt", "yuv444p")),
    ("H.264, 10 bits", ".mp4", (*_X264, "-pix_fmt", "yuv420p10le")),
    ("H.264, B-frames", ".mp4", (*_X264, "-pix_fmt", "yuv420p", "-bf", "3")),
    ("H.264, fragments", ".mp4", (*_X264, "-pix_fmt", "yuv420p", "-movflags", "frag_keyframe+empty_moov")),
    ("H.264, uneven times", ".mp4", (*_UNEVEN, *_X264, "-pix_fmt", "yuv420p")),
    ("H.264, longer sound", ".mp4", (*_SOUND, *_X264, "-pix_fmt", "yuv420p")),
    ("H.264, interlaced", ".mp4", (*_X264, "-pix_fmt", "yuv420p", "-flags", "+ilme+ildct")),
    ("H.264, BT.709", ".mp4", ("-vf", "scale=out_color_matrix=bt709", "-colorspace", "bt709", *_X264)),
    ("H.264, full range", ".mp4", ("-vf", "scale=out_range=full", "-color_range", "pc", *_X264, "-pix_fmt", "yuv420p")),
    ("H.264, raw", ".h264", (*_X264, "-pix_fmt", "yuv420p")),
    ("H.264, Matroska", ".mkv", (*_X264, "-pix_fmt", "yuv420p")),
    ("H.264, transport stream", ".ts", (*_X264, "-pix_fmt", "yuv420p")),
    ("H.264, Flash", ".flv", (*_X264, "-pix_fmt", "yuv420p")),
    ("H.264, AVI", ".avi", (*_X264, "-pix_fmt", "yuv420p", "-bf", "2")),
    ("H.265", ".mp4", ("-c:v", "libx265", "-crf", "5", "-pix_fmt", "yuv420p", "-x265-params", "log-level=none")),
    (
        "H.265, 10 bits",
        ".mkv",
        ("-c:v", "libx265", "-crf", "5", "-pix_fmt", "yuv420p10le", "-x265-params", "log-level=0"),
    ),
    ("VP8", ".webm", ("-c:v", "libvpx", "-crf", "4", "-b:v", "4M")),
    (
        "VP8, alpha",
        ".webm",
        ("-c:v", "libvpx", "-crf", "4", "-b:v", "4M", "-pix_fmt", "yuva420p", "-auto-alt-ref", "0"),
    ),
    ("VP9", ".webm", ("-c:v", "libvpx-vp9", "-crf", "5", "-pix_fmt", "yuv420p")),
    ("VP9, alpha", ".webm", ("-c:v", "libvpx-vp9", "-crf", "5", "-pix_fmt", "yuva420p")),
    ("AV1", ".mp4", ("-c:v", "libaom-av1", "-crf", "5", "-cpu-used", "8", "-pix_fmt", "yuv420p")),
    ("MPEG-1", ".mpg", ("-c:v", "mpeg1video", "-q:v", "1", "-r", "25")),
    ("MPEG-2", ".mpg", ("-c:v", "mpeg2video", "-q:v", "1", "-r", "25")),
    ("MPEG-2, interlaced", ".ts", ("-c:v", "mpeg2video", "-q:v", "1", "-r", "25", "-flags", "+ilme+ildct")),
    ("MPEG-4", ".avi", ("-c:v", "mpeg4", "-q:v", "1", "-bf", "2")),
    ("MPEG-4, 3GP", ".3gp", ("-c:v", "mpeg4", "-q:v", "1")),
    ("Motion JPEG", ".avi", ("-c:v", "mjpeg", "-q:v", "1", "-pix_fmt", "yuvj420p")),
    ("Motion JPEG 2000", ".mov", ("-c:v", "jpeg2000", "-pix_fmt", "rgb24")),
    ("ProRes", ".mov", ("-c:v", "prores_ks", "-pix_fmt", "yuv422p10le")),
    ("ProRes, alpha", ".mov", ("-c:v", "prores_ks", "-profile:v", "4444", "-pix_fmt", "yuva444p10le")),
    ("DNxHR", ".mov", ("-c:v", "dnxhd", "-profile:v", "dnxhr_hq", "-vf", "scale=256:128", "-pix_fmt", "yuv422p")),
    ("QuickTime Animation, alpha", ".mov", ("-c:v", "qtrle", "-pix_fmt", "argb")),
    ("FFV1", ".mkv", ("-c:v", "ffv1", "-pix_fmt", "bgr0")),
    ("FFV1, opaque alpha", ".mkv", ("-c:v", "ffv1", "-pix_fmt", "bgra")),
    ("PNG", ".mov", ("-c:v", "png", "-pix_fmt", "rgb24")),
    ("Theora", ".ogv", ("-c:v", "libtheora", "-q:v", "10")),
    ("Windows Media", ".wmv", ("-c:v", "wmv2", "-q:v", "1")),
    ("uncompressed", ".avi", ("-c:v", "rawvideo", "-pix_fmt", "bgr24")),
    ("YUV4MPEG2", ".y4m", ("-pix_fmt", "yuv444p")),
)


def make_frames() -> np.ndarray:
    """Smooth waves that move, no two frames alike."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    number = np.arange(NUM)[:, None, None]
    waves = (np.sin(0.05 * x + 0.5 * number), np.cos(0.06 * y - 0.4 * number), np.sin(0.04 * (x + y) + 0.3 * number))
    return np.rint(128 + 90 * np.stack(waves, -1)).astype(np.uint8)


def make_file(path: Path, frames: np.ndarray, options: tuple[str, ...]) -> bool:
    """Whether this ffmpeg can encode it. Alpha, where the format has it, falls off towards the right."""
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{WIDTH}x{HEIGHT}", "-r", str(RATE), "-i", "-"]
    with_alpha = any(option.startswith(("yuva", "argb")) for option in options)
    alpha = ("-vf", "format=rgba,geq=r='r(X,Y)':g='g(X,Y)':b='b(X,Y)':a='255-2*X'") if with_alpha else ()
    command = ["ffmpeg", "-v", "error", "-y", *given, *alpha, *options, str(path)]
    return subprocess.run(command, input=frames.tobytes(), capture_output=True, check=False).returncode == 0


def count_by_ffprobe(path: Path) -> int:
    command = ["ffprobe", "-v", "quiet", "-count_frames", "-select_streams", "v:0", "-of", "csv=p=0"]
    found = subprocess.run(
        [*command, "-show_entries", "stream=nb_read_frames", str(path)], capture_output=True, check=False
    )
    text = found.stdout.decode().strip().strip(",")
    return int(text) if text.isdigit() else 0


def count_by_opencv(path: Path) -> int:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    num = sum(1 for _ in iter(lambda: capture.read()[0], False))
    capture.release()
    return num


def read(path: Path, frames: np.ndarray) -> dict[str, object]:
    try:
        clip = read_video(path)
    except VideoError as error:
        return {"refused": str(error).split(": expected ")[-1].split(".")[0][:60]}
    made = {"frames": clip.num_frames, "fps": round(clip.fps, 3), "alpha": clip.has_alpha, "notes": len(clip.notes)}
    if clip.size == (HEIGHT, WIDTH) and clip.num_frames == NUM and not clip.has_alpha:
        made["error"] = round(float(np.abs(clip.frames.astype(int) - frames).mean((1, 2, 3)).max()), 2)
    return made


def _describe(found: dict[str, object] | None) -> str:
    if found is None:
        return ""
    if "refused" in found:
        return f"refused: {found['refused']}"
    error = f", error {found['error']:g}" if "error" in found else ""
    return f"{found['frames']} at {found['fps']:g}{', alpha' if found['alpha'] else ''}{error}"


def main(arguments: list[str] | None = None) -> None:
    parser: argparse.ArgumentParser = _common.parser(__doc__)
    parser.add_argument("--before", type=Path, metavar="FILE", help="the JSON of another version's run")
    options = _common.parse(parser, arguments)
    if shutil.which("ffmpeg") is None:
        raise SystemExit("expected ffmpeg on the PATH, got none. Install it.")
    before = json.loads(options.before.read_text())["kinds"] if options.before else {}
    frames, kinds = make_frames(), {}
    with tempfile.TemporaryDirectory() as folder:
        for name, suffix, how in KINDS:
            path = Path(folder) / f"clip{suffix}"
            if not make_file(path, frames, how):
                console.print(f"{name}: this ffmpeg does not make it")
                continue
            found = read(path, frames)
            kinds[name] = {"foldgauss": found, "opencv": count_by_opencv(path), "ffprobe": count_by_ffprobe(path)}
    columns = ["kind", *(["before"] if before else []), "foldgauss", "OpenCV", "ffprobe"]
    table = _common.table(f"{NUM} frames at {RATE} a second", *columns)
    for name, row in kinds.items():
        old = [_describe(before.get(name, {}).get("foldgauss"))] if before else []
        table.add_row(name, *old, _describe(row["foldgauss"]), str(row["opencv"]), str(row["ffprobe"]))
    console.print(table)
    differing = sum(row["foldgauss"].get("frames") != row["ffprobe"] for row in kinds.values())
    _common.finish(options.json, {"kinds": len(kinds), "differ from ffprobe": differing}, {}, kinds=kinds)


if __name__ == "__main__":
    main()
