"""Losses of your own, by name."""

from collections.abc import Callable

from jaxtyping import Array, Float

#: Losses by name; None is the loss of 3DGS, L1 and D-SSIM, for which each engine has its own code.
LOSSES: dict[str, Callable[[Array, Array], Array] | None] = {"3dgs": None}


def register_loss(
    name: str, function: Callable[[Float[Array, "height width 3"], Float[Array, "height width 3"]], Float[Array, ""]]
) -> None:
    """Make a loss known as `FitConfig(loss=Loss(name=name))`, for all engines.

    `function(image, target)` is the loss of a rendered image, a number; both have values about [0, 1]. JAX compiles and
    differentiates it. Register it again, under the same name, in a process that resumes a fit.

    Example: `register_loss("l1", lambda image, target: abs(image - target).mean())`.
    """
    LOSSES[name] = function
