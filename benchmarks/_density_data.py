"""The data sets of `benchmarks.density`: points along curves, made or measured, and their splits.

All columns have mean 0 and standard deviation 1 over the whole set, so that log-densities of all methods are in the
same units. A split holds out half of the groups; a group is one point of a made set, and a block of a time series.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from sklearn.datasets import make_circles, make_moons, make_swiss_roll

__all__ = ["DATA", "DataSet", "split"]

#: Points of a set, half of which are held out.
POINTS = 2000
SEED = 0
#: Samples of a block of the electrocardiogram, at 360 Hz: 44 ms, so that no QRS complex lies in one block.
BLOCK = 16
#: R peaks are the maxima that stand out by this much.
PEAK = 150
#: Samples between two R peaks at least.
APART = 100
#: A year of fewer weeks does not determine its own trend.
LEAST_WEEKS = 40


class DataSet(NamedTuple):
    """Points, and to which group each belongs."""

    x: Float[np.ndarray, "n d"]
    groups: Int[np.ndarray, " n"]


def split(data: DataSet, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(train, test): half of the groups each, drawn at random."""
    names = np.unique(data.groups)
    chosen = np.random.default_rng([SEED, seed]).permutation(names)[: len(names) // 2]
    train = np.isin(data.groups, chosen)
    return data.x[train], data.x[~train]


def _moons(num: int, rng: np.random.Generator) -> np.ndarray:
    return make_moons(num, noise=0.1, random_state=_seed(rng))[0]


def _rings(num: int, rng: np.random.Generator) -> np.ndarray:
    """Two concentric circles."""
    return make_circles(num, noise=0.06, factor=0.45, random_state=_seed(rng))[0]


def _banana(num: int, rng: np.random.Generator) -> np.ndarray:
    """A normal density bent by a parabola. **Source:** Haario, Saksman and Tamminen 1999."""
    u, v = rng.normal(size=(2, num))
    return np.stack([u, 0.5 * v + u**2], 1)


def _pinwheel(num: int, rng: np.random.Generator) -> np.ndarray:
    """Five arms. **Source:** Johnson et al. 2016, Composing graphical models with neural networks."""
    radial, tangential, arms, rate = 0.3, 0.1, 5, 0.25
    x = rng.normal(size=(num, 2)) * [radial, tangential] + [1, 0]
    angle = 2 * np.pi / arms * rng.integers(0, arms, num) + rate * np.exp(x[:, 0])
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], 1).reshape(num, 2, 2)
    return np.einsum("ni,nij->nj", x, turn)


def _swiss_roll(num: int, rng: np.random.Generator) -> np.ndarray:
    """The roll seen along its axis: a spiral."""
    return make_swiss_roll(num, noise=0.5, random_state=_seed(rng))[0][:, [0, 2]]


def _swiss_roll_3d(num: int, rng: np.random.Generator) -> np.ndarray:
    """A slice of the roll, a third as wide as it is tall."""
    x = make_swiss_roll(num, noise=0.5, random_state=_seed(rng))[0]
    return x * [1, 1 / 3, 1]


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))


def _made(generate: Callable[[int, np.random.Generator], np.ndarray]) -> Callable[[int], DataSet]:
    def load(num: int) -> DataSet:
        return DataSet(_standardize(generate(num, np.random.default_rng(SEED))), np.arange(num))

    return load


def _electrocardiogram(num: int) -> DataSet:
    """(value, phase) of the 1024 samples in PyWavelets, three beats of MIT-BIH; phase 0 is an R peak.

    Values and times are whole numbers in the record: each is read at random within its cell, as a density needs.
    """
    import pywt
    from scipy.signal import find_peaks

    value = np.asarray(pywt.data.ecg(), np.float64)
    peaks = find_peaks(value, prominence=PEAK, distance=APART)[0]
    period = np.diff(peaks).mean()
    rng, index = np.random.default_rng(SEED), np.arange(len(value))
    jitter = rng.uniform(-0.5, 0.5, (2, len(value)))
    beat = np.clip(np.searchsorted(peaks, index, side="right") - 1, 0, len(peaks) - 1)
    phase = (index + jitter[0] - peaks[beat]) / period
    # From a third of a beat before its R peak: the P wave, the QRS complex and the T wave stay together.
    phase = (phase + 1 / 3) % 1.0
    return DataSet(_standardize(np.stack([value + jitter[1], phase], 1)[:num]), (index // BLOCK)[:num])


def _carbon_dioxide(num: int) -> DataSet:
    """(departure from the year's own linear trend, time of year) of the weekly CO2 at Mauna Loa in statsmodels.

    A group is a year, detrended by itself: nothing of a year held out is used in another.
    """
    from statsmodels.datasets import co2

    record = co2.load_pandas().data.dropna()
    rng, years = np.random.default_rng(SEED), record.index.year.to_numpy()
    day = record.index.strftime("%j").astype(int).to_numpy() - 1
    value = record["co2"].to_numpy() + rng.uniform(-0.05, 0.05, len(day))
    phase = (day + rng.uniform(0, 1, len(day))) / 366
    parts, groups = [], []
    for year in np.unique(years):
        own = years == year
        if own.sum() >= LEAST_WEEKS:
            trend = np.polyval(np.polyfit(phase[own], value[own], 1), phase[own])
            parts.append(np.stack([value[own] - trend, phase[own]], 1))
            groups.append(np.full(own.sum(), year))
    return DataSet(_standardize(np.concatenate(parts)[:num]), np.concatenate(groups)[:num])


def _el_nino(num: int) -> DataSet:
    """(temperature, time of year) of the monthly sea surface temperatures of Nino 1+2, 1950 to 2010, in statsmodels.

    A mean of a month is read at a random time within it. A group is a year.
    """
    from statsmodels.datasets import elnino

    record = elnino.load_pandas().data.to_numpy(np.float64)
    value = record[:, 1:]
    month = np.arange(12) + np.random.default_rng(SEED).uniform(0, 1, value.shape)
    groups = np.repeat(record[:, 0].astype(int), 12)
    return DataSet(_standardize(np.stack([value.ravel(), month.ravel()], 1)[:num]), groups[:num])


def _standardize(x: np.ndarray) -> np.ndarray:
    return (x - x.mean(0)) / x.std(0)


#: Loaders by name, of at most so many points; the measured sets are shorter.
DATA: dict[str, Callable[[int], DataSet]] = {
    "moons": _made(_moons),
    "rings": _made(_rings),
    "banana": _made(_banana),
    "pinwheel": _made(_pinwheel),
    "Swiss roll": _made(_swiss_roll),
    "Swiss roll, 3-D": _made(_swiss_roll_3d),
    "ECG": _electrocardiogram,
    "CO2": _carbon_dioxide,
    "El Nino": _el_nino,
}
