"""How noisy frames are, and how much of their pixels' evidence is independent.

A pixel's residual is much like its neighbour's: a plain Gaussian likelihood of a million pixels is far too sure. So the
log-likelihood is scaled by a share below 1, of which two estimates are offered; none is a free lunch, see each.
"""

import dataclasses

import numpy as np
import scipy.fft
from jaxtyping import Float, Float64

from foldgauss._checks import invalid

#: Names of what `frame_time_log_prob` takes for `noise`, besides a FrameNoise.
NOISES = ("score", "effective", "independent")
#: Lags are summed until the mean correlation around a ring falls below this.
LAST_CORRELATION = 0.02


@dataclasses.dataclass(frozen=True)
class FrameNoise:
    r"""Noise of every frame: residuals of standard deviation `scale`, of which a `share` counts.

    .. math:: \ell_k(t) = -\frac{\text{share}_k}{2\, \text{scale}_k^2} \sum_p (y_{kp} - R_p(t))^2

    **Shapes:** `scale` (num_frames,) in units of the pixels' range [0, 1], `share` (num_frames,) in (0, 1]; or numbers
    for all frames. A share of 1 says that all pixels and channels are independent.

    **Source:** a tempered ("composite") likelihood; Pauli, Racugno and Ventura 2011, Bayesian composite marginal
    likelihoods. **Raises:** ValueError for numbers out of range.
    """

    scale: Float64[np.ndarray, "num_frames"]
    share: Float64[np.ndarray, "num_frames"]

    def __post_init__(self):
        for name, limit in (("scale", np.inf), ("share", 1.0)):
            values = np.asarray(getattr(self, name), np.float64)
            if not (np.isfinite(values).all() and (values > 0).all() and (values <= limit).all()):
                expected = "numbers > 0" if limit == np.inf else "numbers in (0, 1]"
                raise invalid(name, expected=expected, got=values.tolist())
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
    def weight(self) -> Float64[np.ndarray, "num_frames"]:
        """What a squared error is multiplied by: share / (2 scale^2)."""
        return self.share / (2 * self.scale**2)


def autocorrelation(
    residual: Float[np.ndarray, "*channels height width"], most: int | None = None
) -> Float64[np.ndarray, "rows columns"]:
    """Correlation of residuals with their neighbours', by lag in y and x; (2 most + 1, 2 most + 1), 1 in the middle.

    The mean over channels, and over any other leading axes, is taken off nothing: residuals of a fit have mean 0, and
    what is left of it is part of what is correlated. Each lag is divided by the number of pairs it has. `most` defaults
    to a third of the shorter side. A residual that is 0 everywhere has correlation 0 but in the middle.
    """
    height, width = residual.shape[-2:]
    most = max(1, min(height, width) // 3) if most is None else most
    if not 0 < most < min(height, width):
        raise invalid("most", expected=f"lags from 1 to {min(height, width) - 1}", got=most)
    planes = np.asarray(residual, np.float64).reshape(-1, height, width)
    sums = _lagged_products(planes, planes, most)
    lags = np.abs(np.arange(-most, most + 1))
    covariance = sums / ((height - lags)[:, None] * (width - lags)[None, :] * len(planes))
    middle = covariance[most, most]
    if middle == 0:
        correlation = np.zeros_like(covariance)
        correlation[most, most] = 1.0
        return correlation
    return covariance / middle


def _lagged_products(one, other, most: int) -> np.ndarray:
    """Sums over planes and pixels of one(p) other(p + lag), lags up to `most` to each side."""
    height, width = one.shape[-2:]
    size = [scipy.fft.next_fast_len(side + most, real=True) for side in (height, width)]
    transformed = [scipy.fft.rfft2(each, size) for each in (one, other)]
    sums = scipy.fft.irfft2((transformed[0].conj() * transformed[1]).sum(0), size)
    return np.roll(sums, (most, most), (0, 1))[: 2 * most + 1, : 2 * most + 1]


def rings(correlation: Float64[np.ndarray, "rows columns"]) -> Float64[np.ndarray, "lags"]:
    """Mean correlation by distance, in whole pixels from 0 on, of what `autocorrelation` gives."""
    most = len(correlation) // 2
    lags = np.arange(-most, most + 1)
    distance = np.rint(np.hypot(lags[:, None], lags[None, :])).astype(int)
    inside = distance <= most
    return np.bincount(distance[inside], correlation[inside]) / np.bincount(distance[inside])


def effective_share(residual: Float[np.ndarray, "channels height width"]) -> float:
    r"""Independent values per value: 1 / (sum of correlations over lags, and over pairs of channels), at most 1.

    It is exact for what depends on the mean of many neighbouring residuals, and cautious for what depends on details.
    The sum ends at the first ring of lags whose mean correlation is below `LAST_CORRELATION`.

    **Source:** the variance of the mean of a stationary process; e.g. Priestley 1981, section 5.3.
    """
    residual = np.asarray(residual, np.float64)
    power = (residual**2).mean()
    if power == 0:
        return 1.0
    together = residual.sum(0)  # the covariance of this is that over all pairs of channels
    correlation = autocorrelation(together)
    reach = rings(correlation)
    below = np.flatnonzero(reach < LAST_CORRELATION)
    last = below[0] if below.size else len(reach)
    most = len(correlation) // 2
    lags = np.arange(-most, most + 1)
    inside = np.rint(np.hypot(lags[:, None], lags[None, :])) < last
    inflation = (together**2).mean() / (len(residual) * power) * correlation[inside].sum()
    return float(min(1.0, 1.0 / inflation)) if inflation > 0 else 1.0


def score_share(
    residual: Float[np.ndarray, "channels height width"], slope: Float[np.ndarray, "channels height width"], reach: int
) -> float:
    r"""The share with which the likelihood of a time is as sure as its score is steady, at most 1.

    With the residual r and the slope g = dR/dt, scores s_p = r_p g_p have the sum whose variance V is estimated with
    their covariances up to `reach` pixels (those up to half of it in full, then less and less), where the plain
    likelihood takes J = scale^2 sum g^2 for granted: share = J / V. Exact where residuals are as correlated in seen
    frames as noise is; a fit that has learned the noise leaves residuals whose scores cancel, and then it is too sure.

    **Source:** the sandwich of Huber 1967; covariances over two dimensions as Conley 1999, with the flat-topped weights
    of Politis and Romano 1995: Bartlett's would miss a quarter of V at the reach that profiles use.
    """
    residual, slope = (np.asarray(each, np.float64) for each in (residual, slope))
    expected = (residual**2).mean() * (slope**2).sum()
    score = (residual * slope).sum(0)
    score -= score.mean()
    lags = np.abs(np.arange(-reach, reach + 1))
    flat = np.clip(2 - 2 * lags / (reach + 1), 0, 1)
    weights = flat[:, None] * flat[None, :]
    variance = (weights * _lagged_products(score[None], score[None], reach)).sum()
    # Taking off the mean makes all covariances together 0: what that takes from those that are summed.
    height, width = score.shape
    pairs = np.maximum(height - lags, 0)[:, None] * np.maximum(width - lags, 0)[None, :]
    variance /= max(1 - (weights * pairs).sum() / score.size**2, 0.1)
    if not (expected > 0 and variance > 0):
        return 1.0
    return float(min(1.0, expected / variance))
