"""Losses of your own, by name."""

from collections.abc import Callable

from jaxtyping import Array, Float

from foldgauss._runtime.checks import require

#: Losses by name; None is the loss of 3DGS, L1 and D-SSIM, for which each engine has its own code.
LOSSES: dict[str, Callable[[Array, Array], Array] | None] = {"3dgs": None}


def register_loss(
    name: str, function: Callable[[Float[Array, "height width 3"], Float[Array, "height width 3"]], Float[Array, ""]]
) -> None:
    """Make a loss known as `FitConfig(loss=Loss(name=name))`, for all engines.

    `function(image, target)` is the loss of a rendered image, a number; both have values about [0, 1]. JAX compiles and
    differentiates it. Register it again, under the same name, in a process that resumes a fit. For the last
    `Loss.l2_fraction` of the steps the squared error takes its place. Gradients at the outermost pixels are multiplied
    by `Loss.border_weight`.

    Raises ValueError for the name of the built-in loss.

    Example: `register_loss("l1", lambda image, target: abs(image - target).mean())`.
    """
    require(LOSSES.get(name, function) is not None, "name", expected="one that is not built in", got=repr(name))
    LOSSES[name] = function
