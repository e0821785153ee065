"""The evidence that `uncertainty` keeps, so that a run that goes on draws no pictures again."""

import io
import zipfile
from pathlib import Path

import numpy as np

from foldgauss.io._atomic import atomic_path
from foldgauss.uncertainty import FrameNoise, LikelihoodProfiles, ProfileCurves

_PROFILES = ("nodes", "values", "slopes", "count")
#: Bytes of a member beside its numbers: the header of a NumPy array, which has 64 to 128.
_HEADER = 1024


def keep_evidence(path: Path, key: str, profiles: LikelihoodProfiles) -> None:
    """Write it; `key` is of all that it depends on."""
    arrays = {name: getattr(profiles.curves, name) for name in _PROFILES}
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


def kept_evidence(path: Path, key: str, num_frames: int) -> LikelihoodProfiles | None:
    """What `keep_evidence` wrote under this key, or None: no such file, of another key, or damaged.

    The file may come from a stranger: no array has more bytes than there are, and profiles fit each other, as compiled
    code looks them up unchecked.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            kept = {name: _array(archive, f"{name}.npy") for name in ("key",)}
            if str(kept["key"]) != key:
                return None
            names = (*_PROFILES, "scale", "share", "correlation", "num_drawn", "level", "notes")
            kept |= {name: _array(archive, f"{name}.npy") for name in names}
        curves = _checked_profiles(*(kept[name] for name in _PROFILES), num_frames)
        noise = FrameNoise(_floats(kept["scale"], (num_frames,)), _floats(kept["share"], (num_frames,)))
        correlation = _floats(kept["correlation"], np.shape(kept["correlation"])[:1])
        told = str(kept["level"]), tuple(map(str, np.atleast_1d(kept["notes"])))
        return LikelihoodProfiles(curves, noise, correlation, int(kept["num_drawn"]), *told)
    except Exception:  # of what kind depends on where it is damaged; it is drawn anew
        return None


def is_evidence(path: Path) -> bool:
    """Whether `keep_evidence` may have written it: its parts have these names."""
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist()) >= {f"{name}.npy" for name in ("key", *_PROFILES)}
    except Exception:  # as above
        return False


def _array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """One member; stored as it is, and no longer than its header says."""
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
        raise ValueError("it is compressed")
    data = archive.read(info)
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, _, dtype = read_header(file)
    num = dtype.itemsize
    for length in shape:  # whole numbers without an end, where NumPy's would turn over
        num *= length
    if num < 0 or num > len(data) or len(data) - num > _HEADER:
        raise ValueError("it is longer or shorter than it says")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def _floats(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if array.dtype != np.float64 or array.shape != shape:
        raise ValueError(f"expected float64 {shape}, got {array.dtype} {array.shape}")
    return array


def _checked_profiles(
    nodes: np.ndarray, values: np.ndarray, slopes: np.ndarray, count: np.ndarray, num_frames: int
) -> ProfileCurves:
    shape = nodes.shape
    if len(shape) != 2 or count.shape != (num_frames,) or count.dtype.kind != "i":
        raise ValueError("tables of another shape")
    for table in (nodes, values, slopes):
        _floats(table, (num_frames, shape[1]))
    if (count < 3).any() or (count > shape[1]).any():
        raise ValueError("counts out of range")
    used = np.arange(shape[1]) < count[:, None]
    if not all(np.isfinite(table[used]).all() for table in (nodes, values, slopes)):
        raise ValueError("numbers that are not finite")
    if not (np.diff(nodes, axis=1)[used[:, 1:]] > 0).all():
        raise ValueError("times that do not rise")
    return ProfileCurves(nodes, values, slopes, count)
