"""The file of likelihood profiles that `uncertainty` writes, so that a resumed run need not render again."""

import io
import zipfile
from pathlib import Path

import numpy as np

from foldgauss.io._atomic import atomic_path
from foldgauss.uncertainty import FrameNoise, LikelihoodProfiles, ProfileCurves

_CURVES = ("nodes", "values", "slopes", "count")
#: Largest header of a NumPy array in bytes; usual are 64 to 128.
_HEADER = 1024


def save_profiles(path: Path, key: str, profiles: LikelihoodProfiles) -> None:
    """Write the profiles; `key` identifies everything that they depend on."""
    arrays = {name: getattr(profiles.curves, name) for name in _CURVES}
    arrays |= {
        "scale": profiles.noise.scale,
        "share": profiles.noise.fraction,
        "correlation": profiles.residual_correlation,
    }
    with atomic_path(path) as temporary:
        np.savez(
            temporary,
            key=key,
            num_drawn=profiles.num_rendered,
            level=profiles.level,
            notes=list(profiles.notes),
            **arrays,
        )


def load_profiles(path: Path, key: str, num_frames: int) -> LikelihoodProfiles | None:
    """Read the profiles with this key; None if the file is missing, has another key or is damaged.

    The file may be of unknown origin: the sizes and shapes of arrays are checked, since compiled code does not.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            kept = {"key": _read_array(archive, "key.npy")}
            if str(kept["key"]) != key:
                return None
            names = (*_CURVES, "scale", "share", "correlation", "num_drawn", "level", "notes")
            kept |= {name: _read_array(archive, f"{name}.npy") for name in names}
        curves = _check_curves(*(kept[name] for name in _CURVES), num_frames)
        noise = FrameNoise(_check_floats(kept["scale"], (num_frames,)), _check_floats(kept["share"], (num_frames,)))
        correlation = _check_floats(kept["correlation"], np.shape(kept["correlation"])[:1])
        text = str(kept["level"]), tuple(map(str, np.atleast_1d(kept["notes"])))
        return LikelihoodProfiles(curves, noise, correlation, int(kept["num_drawn"]), *text)
    except Exception:  # its type depends on the damage
        return None


def is_profiles_file(path: Path) -> bool:
    """Whether a file has the parts that `save_profiles` writes."""
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist()) >= {f"{name}.npy" for name in ("key", *_CURVES)}
    except Exception:  # as above
        return False


def _read_array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Read an array, which must be uncompressed and as long as its header states."""
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
        raise ValueError("it is compressed")
    data = archive.read(info)
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, _, dtype = read_header(file)
    num = dtype.itemsize
    for length in shape:  # integers of Python do not overflow
        num *= length
    if num < 0 or num > len(data) or len(data) - num > _HEADER:
        raise ValueError("the length differs from the header")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def _check_floats(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.dtype != np.float64 or array.shape != shape:
        raise ValueError(f"expected float64 {shape}, got {array.dtype} {array.shape}")
    return array


def _check_curves(
    nodes: np.ndarray, values: np.ndarray, slopes: np.ndarray, count: np.ndarray, num_frames: int
) -> ProfileCurves:
    shape = nodes.shape
    if len(shape) != 2 or count.shape != (num_frames,) or count.dtype.kind != "i":
        raise ValueError("unexpected shapes")
    for table in (nodes, values, slopes):
        _check_floats(table, (num_frames, shape[1]))
    if (count < 3).any() or (count > shape[1]).any():
        raise ValueError("counts out of range")
    used = np.arange(shape[1]) < count[:, None]
    if not all(np.isfinite(table[used]).all() for table in (nodes, values, slopes)):
        raise ValueError("values that are not finite")
    if not (np.diff(nodes, axis=1)[used[:, 1:]] > 0).all():
        raise ValueError("times that do not increase")
    return ProfileCurves(nodes, values, slopes, count)
