"""How noisy frames are, and how much of their pixels' evidence is independent.

A pixel's residual is much like its neighbour's: a plain Gaussian likelihood of a million pixels is far too sure. So the
log-likelihood is scaled by a share below 1, of which two estimates are offered; none is a free lunch, see each.
"""

import dataclasses

import numpy as np
import scipy.fft
import scipy.ndimage
from jaxtyping import Float, Float64

from foldgauss._runtime.checks import invalid

#: Names of what `frame_time_log_prob` takes for `noise`, besides a FrameNoise.
NOISES = ("score", "effective", "independent")
#: Lags are summed until the mean correlation around a ring falls below this.
LAST_CORRELATION = 0.02
#: Pixels over which the size of residuals is taken: they are greatest at edges, which is where pictures tell time.
LOCAL = 1.0


@dataclasses.dataclass(frozen=True)
class FrameNoise:
    r"""Noise of every frame: residuals of standard deviation `scale`, of which a `share` counts.

    $$ \ell_k(t) = -\frac{\text{share}_k}{2\, \text{scale}_k^2} \sum_p (y_{kp} - R_p(t))^2 $$

    **Shapes:** `scale` (num_frames,) in units of the pixels' range [0, 1], `share` (num_frames,) in (0, 1]; or numbers
    for all frames. A share of 1 says that all pixels and channels are independent.

    **Source:** a tempered ("composite") likelihood; Pauli, Racugno and Ventura 2011, Bayesian composite marginal
    likelihoods. **Raises:** ValueError for numbers out of range.
    """

    scale: Float64[np.ndarray, " num_frames"]
    share: Float64[np.ndarray, " num_frames"]

    def __post_init__(self):
        told = {
            "scale": (np.inf, "numbers > 0", "5 grey levels are 5 / 255."),
            "share": (1.0, "numbers in (0, 1]", "1 counts every value, 1/30 one in 30."),
        }
        for name, (limit, expected, cure) in told.items():
            values = np.asarray(getattr(self, name), np.float64)
            if not (np.isfinite(values).all() and (values > 0).all() and (values <= limit).all()):
                raise invalid(name, expected=expected, got=values.tolist(), cure=cure)
            object.__setattr__(self, name, values)

    def of(self, num_frames: int) -> "FrameNoise":
        """The same with an entry for each of `num_frames` frames."""
        for name in ("scale", "share"):
            if getattr(self, name).shape not in ((), (1,), (num_frames,)):
                got = f"shape {getattr(self, name).shape}"
                raise invalid(f"noise.{name}", expected=f"a number or {num_frames} of them", got=got)
        return FrameNoise(*(np.broadcast_to(value, num_frames).copy() for value in (self.scale, self.share)))

    def told(self) -> str:
        """In words: how great residuals are, and how many of them count."""
        low, middle, high = (f"{n:,.0f}" if n >= 10 else f"{n:.2g}" for n in 1 / np.quantile(self.share, [1, 0.5, 0]))
        counted = "all values count" if middle == "1" else f"one value in {middle} counts"
        between = "" if low == high else f" (frames: one in {low} to {high})"
        return f"residuals of {255 * np.median(self.scale):.2g} grey levels, {counted}{between}"

    @property
    def weight(self) -> Float64[np.ndarray, " num_frames"]:
        """What a squared error is multiplied by: share / (2 scale^2)."""
        return self.share / (2 * self.scale**2)


_Covariance = Float64[np.ndarray, "channels channels rows columns"]


def covariances(residual: Float[np.ndarray, "channels height width"], most: int | None = None) -> _Covariance:
    """Means of r_c(p) r_d(p + lag) for all pairs of channels, lags up to `most` in y and x; 0 in the middle.

    No mean is taken off: residuals of a fit have mean 0, and what is left of it is part of what is correlated. Each lag
    is divided by the number of pairs it has. `most` defaults to a third of the shorter side.
    """
    height, width = residual.shape[-2:]
    most = max(1, min(height, width) // 3) if most is None else most
    if not 0 < most < min(height, width):
        raise invalid("most", expected=f"lags from 1 to {min(height, width) - 1}", got=most)
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
    """Correlation of residuals with their neighbours', of `covariances`: the mean over channels, 1 in the middle.

    Where there is no residual at all it is 0 but in the middle.
    """
    same = np.einsum("ccyx->yx", covariance)
    most = len(same) // 2
    if same[most, most] == 0:
        correlation = np.zeros_like(same)
        correlation[most, most] = 1.0
        return correlation
    return same / same[most, most]


def rings(correlation: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, " lags"]:
    """Mean correlation by distance, in whole pixels from 0 on, of what `autocorrelation` gives."""
    most = len(correlation) // 2
    lags = np.arange(-most, most + 1)
    distance = np.rint(np.hypot(lags[:, None], lags[None, :])).astype(int)
    inside = distance <= most
    return np.bincount(distance[inside], correlation[inside]) / np.bincount(distance[inside])


def correlated_reach(covariance: _Covariance) -> int:
    """The first ring of lags, in pixels, whose mean correlation is below `LAST_CORRELATION`."""
    correlation = rings(autocorrelation(covariance))
    below = np.flatnonzero(correlation < LAST_CORRELATION)
    return int(below[0]) if below.size else len(correlation)


def effective_share(covariance: _Covariance) -> float:
    r"""Independent values per value, at most 1: 1 over the greatest sum of correlations that any colour has.

    With the residuals' `covariances`, summed over lags to a matrix over channels, it is the mean variance over the
    matrix's greatest eigenvalue. Exact for what depends on the mean of many neighbouring residuals of that colour,
    and cautious for what depends on details. The sum ends at `correlated_reach`.

    **Source:** the variance of the mean of a stationary process; e.g. Priestley 1981, section 5.3.
    """
    most = covariance.shape[-1] // 2
    power = np.einsum("cc->", covariance[..., most, most]) / len(covariance)
    if power == 0:
        return 1.0
    lags = np.arange(-most, most + 1)
    inside = np.rint(np.hypot(lags[:, None], lags[None, :])) < correlated_reach(covariance)
    together = covariance[..., inside].sum(-1)
    inflation = float(np.linalg.eigvalsh((together + together.T) / 2)[-1] / power)
    return min(1.0, 1.0 / inflation) if inflation > 0 else 1.0


def score_share(
    residual: Float[np.ndarray, "channels height width"],
    slope: Float[np.ndarray, "channels height width"],
    covariance: _Covariance,
) -> float:
    r"""The share with which the likelihood of a time is as sure as its score is steady, at most 1.

    The score is the sum over pixels of r g, with the residual r and the slope g = dR/dt. The plain likelihood takes its
    variance for J = scale^2 sum g^2. Here it is V, the greater of two estimates, and the share is J / V:

    $$
    V_1 = \sum_{p, h} \rho(h)\, s_p g_p\, s_{p + h} g_{p + h},
    \qquad V_2 = \sum_{p, h} r_p g_p\, r_{p + h} g_{p + h}
    $$

    summed over channels, too, over lags h up to twice the `correlated_reach` (in full up to half of it, then less and
    less). The first, with the residual's size s around p and the correlations rho of `covariance`, best those of many
    frames, is that of noise which knows nothing of the slope. The second is that of residuals as they are, which lie
    along edges as slopes do; but at the best time they cancel over few pixels. A fit that has learned the noise
    leaves less of both than noise is, and then this is too sure.

    **Source:** the sandwich of Huber 1967; covariances over two dimensions as Conley 1999, with the flat-topped weights
    of Politis and Romano 1995.
    """
    residual, slope = (np.asarray(each, np.float64) for each in (residual, slope))
    middle = covariance.shape[-1] // 2
    power = np.einsum("cc->", covariance[..., middle, middle]) / len(covariance)
    plain = (residual**2).mean() * (slope**2).sum()
    if not (power > 0 and plain > 0):
        return 1.0
    reach = min(max(2 * correlated_reach(covariance), 1), middle)
    near = slice(middle - reach, middle + reach + 1)
    flat = np.clip(2 - 2 * np.abs(np.arange(-reach, reach + 1)) / (reach + 1), 0, 1)
    weights = flat[:, None] * flat[None, :]
    local = np.sqrt(scipy.ndimage.gaussian_filter((residual**2).mean(0), LOCAL))
    variance = float((weights * covariance[..., near, near] * _lagged_products(local * slope, reach)).sum() / power)
    variance = max(variance, _own_variance((residual * slope).sum(0), weights))
    return min(1.0, plain / variance) if variance > 0 else effective_share(covariance)


def _own_variance(score: np.ndarray, weights: np.ndarray) -> float:
    """Of a sum over pixels, by the pixels' own covariances about their mean; `weights` by lag."""
    reach, (height, width) = len(weights) // 2, score.shape
    lags = np.abs(np.arange(-reach, reach + 1))
    variance = float((weights * _lagged_products((score - score.mean())[None], reach)[0, 0]).sum())
    # Taking off the mean makes all covariances together 0: what that takes from those that are summed.
    pairs = np.maximum(height - lags, 0)[:, None] * np.maximum(width - lags, 0)[None, :]
    return variance / max(1 - float((weights * pairs).sum()) / score.size**2, 0.1)
