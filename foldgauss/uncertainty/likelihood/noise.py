"""The noise model: residual scale per frame, and the power to which the likelihood is tempered.

Residuals of neighboring pixels are correlated, so a Gaussian likelihood of independent pixels is far too narrow. The
log-likelihood is therefore multiplied by a fraction below 1.
"""

import dataclasses

import numpy as np
import scipy.fft
import scipy.ndimage
from jaxtyping import Float, Float64

from foldgauss._runtime.checks import require

#: Names that `likelihood_profiles` accepts for `noise`, besides a FrameNoise.
NOISES = ("score", "independent")
#: Lags are summed until the mean correlation on a ring falls below this.
LAST_CORRELATION = 0.02
#: Standard deviation in pixels of the local residual power: residuals are largest at edges, which also determine time.
LOCAL = 1.0


@dataclasses.dataclass(frozen=True)
class FrameNoise:
    r"""Noise of every frame: residuals of standard deviation `scale`, and the `fraction` that tempers the likelihood.

    $$ \ell_k(t) = -\frac{\text{fraction}_k}{2\, \text{scale}_k^2} \sum_p (y_{kp} - R_p(t))^2 $$

    **Shapes:** `scale` (num_frames,) in units of the pixels' range [0, 1], `fraction` (num_frames,) in (0, 1]; or one
    number each for all frames. A fraction of 1 means that all pixels and channels are independent.

    **Source:** a tempered ("composite") likelihood; Pauli, Racugno and Ventura 2011, Bayesian composite marginal
    likelihoods. **Raises:** ValueError for values out of range.
    """

    scale: Float64[np.ndarray, " num_frames"]
    fraction: Float64[np.ndarray, " num_frames"]

    def __post_init__(self):
        limits = {
            "scale": (np.inf, "numbers > 0", "5 gray levels are 5 / 255."),
            "fraction": (1.0, "numbers in (0, 1]", "1 counts every value, 1/30 one value in 30."),
        }
        for name, (limit, expected, cure) in limits.items():
            values = np.asarray(getattr(self, name), np.float64)
            require(
                np.isfinite(values).all() and (values > 0).all() and (values <= limit).all(),
                name,
                expected=expected,
                got=values.tolist(),
                cure=cure,
            )
            object.__setattr__(self, name, values)

    def for_frames(self, num_frames: int) -> "FrameNoise":
        """Broadcast to one entry per frame."""
        for name in ("scale", "fraction"):
            require(
                getattr(self, name).shape in ((), (1,), (num_frames,)),
                f"noise.{name}",
                expected=f"a number or {num_frames} of them",
                got=f"shape {getattr(self, name).shape}",
            )
        return FrameNoise(*(np.broadcast_to(value, num_frames).copy() for value in (self.scale, self.fraction)))

    def describe(self) -> str:
        """In words: how great residuals are, and how many of them count."""
        low, middle, high = (
            f"{n:,.0f}" if n >= 10 else f"{n:.2g}" for n in 1 / np.quantile(self.fraction, [1, 0.5, 0])
        )
        counted = "all values count" if middle == "1" else f"one value in {middle} counts"
        between = "" if low == high else f" (frames: one in {low} to {high})"
        return f"residuals of {255 * np.median(self.scale):.2g} gray levels, {counted}{between}"

    @property
    def weight(self) -> Float64[np.ndarray, " num_frames"]:
        """The factor of squared errors in the log-likelihood: fraction / (2 scale^2)."""
        return self.fraction / (2 * self.scale**2)


_Covariance = Float64[np.ndarray, "channels channels rows columns"]


def covariances(residual: Float[np.ndarray, "channels height width"], most: int | None = None) -> _Covariance:
    """Means of r_c(p) r_d(p + lag) for all pairs of channels and lags up to `most` in y and x; lag 0 in the middle.

    The mean is not subtracted: residuals of a fit have mean near 0, and the rest of it is part of the correlation. Each
    lag is divided by its number of pairs. `most` defaults to a third of the shorter side.
    """
    height, width = residual.shape[-2:]
    most = max(1, min(height, width) // 3) if most is None else most
    require(0 < most < min(height, width), "most", expected=f"lags from 1 to {min(height, width) - 1}", got=most)
    lags = np.abs(np.arange(-most, most + 1))
    return _lagged_products(residual, most) / ((height - lags)[:, None] * (width - lags)[None, :])


def _lagged_products(planes: np.ndarray, most: int) -> np.ndarray:
    """Sums over pixels of one(p) other(p + lag), for all pairs of planes and lags up to `most` to each side."""
    height, width = planes.shape[-2:]
    size = [scipy.fft.next_fast_len(side + most, real=True) for side in (height, width)]
    waves = scipy.fft.rfft2(np.asarray(planes, np.float64), size)
    num, lags = len(planes), 2 * most + 1
    sums = np.empty((num, num, lags, lags))
    for c in range(num):
        for d in range(c, num):
            product = np.roll(scipy.fft.irfft2(waves[c].conj() * waves[d], size), (most, most), (0, 1))[:lags, :lags]
            sums[c, d], sums[d, c] = product, product[::-1, ::-1]
    return sums


def autocorrelation(
    covariance: _Covariance,
) -> Float64[np.ndarray, "rows columns"]:
    """Autocorrelation of residuals from `covariances`: the mean over channels, 1 in the middle.

    Residuals that are all 0 give 0 at all other lags.
    """
    same = np.einsum("ccyx->yx", covariance)
    most = len(same) // 2
    correlation = same / (same[most, most] or 1.0)
    correlation[most, most] = 1.0
    return correlation


def rings(correlation: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, " lags"]:
    """Mean of an `autocorrelation` by distance, in whole pixels from 0 on."""
    most = len(correlation) // 2
    lags = np.arange(-most, most + 1)
    distance = np.rint(np.hypot(lags[:, None], lags[None, :])).astype(int)
    inside = distance <= most
    return np.bincount(distance[inside], correlation[inside]) / np.bincount(distance[inside])


def correlated_reach(correlation: Float[np.ndarray, " lags"]) -> int:
    """The first of the `rings` whose mean correlation is below `LAST_CORRELATION`; their number if there is none."""
    below = np.flatnonzero(correlation < LAST_CORRELATION)
    return int(below[0]) if below.size else len(correlation)


def score_fraction(
    residual: Float[np.ndarray, "channels height width"],
    slope: Float[np.ndarray, "channels height width"],
    covariance: _Covariance,
) -> float:
    r"""The fraction by which the likelihood of a time is tempered to match the sandwich variance, at most 1.

    The score is the sum over pixels of r g, with the residual r and the slope g = dR/dt. For independent pixels its
    variance is J = scale^2 sum g^2. Here it is V, the larger of two estimates, and the fraction is J / V:

    $$
    V_1 = \sum_{p, h} \rho(h)\, s_p g_p\, s_{p + h} g_{p + h},
    \qquad V_2 = \sum_{p, h} r_p g_p\, r_{p + h} g_{p + h}
    $$

    also summed over channels, with lags h up to twice the `correlated_reach`, tapered from half of that on. V_1 is for
    noise independent of the slope, with the local residual scale s and the correlations rho of `covariance`, preferably
    the mean of many frames; V_2 uses the residuals. A fit that has learned part of the noise reduces both, and the
    fraction is then too large.

    **Source:** the sandwich of Huber 1967; covariances over two dimensions as Conley 1999, with the flat-topped weights
    of Politis and Romano 1995.
    """
    residual, slope = (np.asarray(each, np.float64) for each in (residual, slope))
    middle = covariance.shape[-1] // 2
    power = np.einsum("cc->", covariance[..., middle, middle]) / len(covariance)
    plain = (residual**2).mean() * (slope**2).sum()
    if not (power > 0 and plain > 0):
        return 1.0
    reach = min(max(2 * correlated_reach(rings(autocorrelation(covariance))), 1), middle)
    near = slice(middle - reach, middle + reach + 1)
    flat = np.clip(2 - 2 * np.abs(np.arange(-reach, reach + 1)) / (reach + 1), 0, 1)
    weights = flat[:, None] * flat[None, :]
    local = np.sqrt(scipy.ndimage.gaussian_filter((residual**2).mean(0), LOCAL))
    variance = float((weights * covariance[..., near, near] * _lagged_products(local * slope, reach)).sum() / power)
    variance = max(variance, _own_variance((residual * slope).sum(0), weights))
    return min(1.0, plain / variance) if variance > 0 else 1.0


def _own_variance(score: np.ndarray, weights: np.ndarray) -> float:
    """Variance of a sum over pixels from the pixels' covariances about their mean; `weights` by lag."""
    reach, (height, width) = len(weights) // 2, score.shape
    lags = np.abs(np.arange(-reach, reach + 1))
    variance = float((weights * _lagged_products((score - score.mean())[None], reach)[0, 0]).sum())
    # Subtracting the mean makes all covariances sum to 0: this corrects those that are summed.
    pairs = np.maximum(height - lags, 0)[:, None] * np.maximum(width - lags, 0)[None, :]
    return variance / max(1 - float((weights * pairs).sum()) / score.size**2, 0.1)
