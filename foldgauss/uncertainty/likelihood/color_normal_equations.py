"""Normal equations of the colors of a model's splats, given the frames of a video at given times."""

import functools
from collections.abc import Callable

import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Float, Float64

from foldgauss._runtime.checks import invalid
from foldgauss.render import cpu
from foldgauss.uncertainty.likelihood.noise import FrameNoise
from foldgauss.uncertainty.likelihood.residuals import Residuals
from foldgauss.video.models.background import BLACK
from foldgauss.video.models.conditioning import PreparedModel
from foldgauss.video.models.splats import SH_C0

#: Gaussians per block of the preconditioner: larger blocks cost about as much time as they save.
BLOCK = 512
#: Iteration limit of the solver. The 40,000 Gaussians of a fitted clip take 40 to 200.
MAX_ITERATIONS = 2000

_behind = np.asarray(BLACK, np.float32)
_level = 1 / 255


class ColorEquations:
    r"""H c = b for the offsets c of all colors from the model's own, given every frame at its time.

    $$ H = \lambda^{-2} I + \sum_j A_j^T A_j / s_j^2, \quad b = \sum_j A_j^T (y_j - A_j c_0) / s_j^2 $$

    with $\lambda$ the `prior_scale` and $s_j^2$ = scale^2 / fraction. Images are A c, linear in c, since
    the clamp of colors at 0 is neglected. `matrix`: sparse (num, num), `rhs`: (num, 3).
    """

    def __init__(
        self, residuals: Residuals, noise: FrameNoise, times: Float64[np.ndarray, " num_frames"], prior_scale: float
    ):
        self.residuals, self.times, self.variance = residuals, times, 1 / (2 * noise.weight)
        self.num = residuals.model.num_gaussians
        dc = np.asarray(residuals.model.splats.color_dc, np.float64)
        self.color = np.maximum(0.5 + SH_C0 * dc, 0.0)
        self._prepared = PreparedModel(residuals.model, residuals.model.size)
        self._accumulate(prior_scale)

    def weights(self, t: float) -> scipy.sparse.csr_array:
        """A(t): (pixels, num), in double precision; the image at t is A(t) times the colors."""
        alive = self._prepared.at(t)
        leaves = alive.mean, alive.factor, alive.opacity, alive.color, _behind
        model = self.residuals.model
        found = cpu.build_weight_matrix(
            cpu.forward(*leaves, model.size, compositing=model.compositing, options=model.options)
        )
        indices = alive.alive.astype(np.int32)[found.indices]
        shape = (found.shape[0], self.num)
        return scipy.sparse.csr_array((found.data.astype(np.float64), indices, found.indptr), shape=shape)

    def residual(self, k: int, weights: scipy.sparse.csr_array) -> Float64[np.ndarray, "pixels 3"]:
        """Frame k less the image with the model's own colors."""
        return self.residuals.frames[k].reshape(-1, 3) * _level - weights @ self.color

    def _accumulate(self, prior_scale: float) -> None:
        self.matrix = scipy.sparse.diags_array(np.full(self.num, prior_scale**-2), format="csr")
        self.rhs = np.zeros((self.num, 3))
        for k, t in enumerate(self.times):
            here = self.weights(t)
            self.rhs += here.T @ self.residual(k, here) / self.variance[k]
            self.matrix = self.matrix + here.T @ here / self.variance[k]
        self.matrix = self.matrix.tocsr()
        self.matrix.sort_indices()

    @functools.cached_property
    def precondition(self) -> Callable[[np.ndarray], np.ndarray]:
        """Block-Jacobi preconditioner over blocks of neighboring Gaussians, in single precision."""
        blocks = _partition(np.asarray(self.residuals.model.splats.loc, np.float64), BLOCK)
        order = np.concatenate(blocks)
        matrix = self.matrix[order][:, order]
        ends = np.cumsum([len(block) for block in blocks])
        inverses = []
        for block, end in zip(blocks, ends, strict=True):
            dense = matrix[end - len(block) : end, end - len(block) : end].toarray()
            inverses.append(scipy.linalg.inv(dense, check_finite=False).astype(np.float32))

        def apply(vectors: np.ndarray) -> np.ndarray:
            found = np.empty_like(vectors)
            for block, inverse in zip(blocks, inverses, strict=True):
                found[block] = inverse @ vectors[block].astype(np.float32)
            return found

        return apply

    @functools.cached_property
    def solution(self) -> Float64[np.ndarray, "num 3"]:
        """Offsets of the colors given all frames at their times: the initial guess for other times."""
        return solve_conjugate_gradient(
            lambda x: self.matrix @ x, self.precondition, self.rhs, np.zeros_like(self.rhs), 1e-4
        )


class FrameAt:
    """The equations with one frame moved to another time, as a low-rank update."""

    def __init__(self, equations: ColorEquations, k: int, t: float):
        self.equations, self.k, self.t = equations, k, t
        self.variance = equations.variance[k]
        self.weights = equations.weights(t)
        self.residual = equations.residual(k, self.weights)
        self._taken = equations.weights(equations.times[k])
        without = equations.rhs - self._taken.T @ equations.residual(k, self._taken) / self.variance
        self.rhs = without + self.weights.T @ self.residual / self.variance

    def __matmul__(self, x: np.ndarray) -> np.ndarray:
        changed = self.weights.T @ (self.weights @ x) - self._taken.T @ (self._taken @ x)
        return self.equations.matrix @ x + changed / self.variance

    def dense(self) -> Float64[np.ndarray, "num num"]:
        changed = self.weights.T @ self.weights - self._taken.T @ self._taken
        return self.equations.matrix.toarray() + changed.toarray() / self.variance


def solve_conjugate_gradient(
    product: Callable[[np.ndarray], np.ndarray],
    precondition: Callable[[np.ndarray], np.ndarray],
    rhs: Float64[np.ndarray, "num columns"],
    start: Float64[np.ndarray, "num columns"],
    tolerance: float | Float[np.ndarray, " columns"],
) -> Float64[np.ndarray, "num columns"]:
    """Preconditioned conjugate gradients, columnwise, until residuals are `tolerance` times the right-hand sides.

    Norms are those of the preconditioner. Raises ValueError without convergence. Source: Hestenes and Stiefel 1952.
    """
    x, goal = start.copy(), np.maximum(tolerance**2 * (rhs * precondition(rhs)).sum(0), np.finfo(float).tiny)
    residual = rhs - product(x)
    preconditioned = precondition(residual)
    direction, norm = preconditioned.copy(), (residual * preconditioned).sum(0)  # squared norms, as `goal`
    for _ in range(MAX_ITERATIONS):
        if (norm <= goal).all():
            break
        change = product(direction)
        curvature = (direction * change).sum(0)
        step = np.divide(norm, curvature, out=np.zeros_like(norm), where=curvature > 0)
        x += step * direction
        residual -= step * change
        preconditioned = precondition(residual)
        norm, before = (residual * preconditioned).sum(0), norm
        direction = preconditioned + np.divide(norm, before, out=np.zeros_like(norm), where=before > 0) * direction
    else:
        got = f"{np.sqrt((norm / goal).max()):.2g} times that after {MAX_ITERATIONS}"
        cure = "A smaller prior_scale converges faster."
        raise invalid("prior_scale", expected=f"colors solved to {np.max(tolerance):g}", got=got, cure=cure)
    return x


def _partition(places: Float64[np.ndarray, "num 2"], most: int) -> list[np.ndarray]:
    """Blocks of at most `most` neighboring Gaussians: columns of about equally many, divided along y."""
    num_blocks = -(-len(places) // most)
    columns = max(round(num_blocks**0.5), 1)
    column = np.argsort(np.argsort(places[:, 0], kind="stable")) * columns // len(places)
    return np.array_split(np.lexsort((places[:, 1], column)), num_blocks)
