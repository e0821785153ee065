"""JAX's default device."""

import jax


def default_platform() -> str:
    """The platform of JAX's default device, such as "cpu" or "gpu", also where `jax.default_device` has chosen it.

    As a context, `jax.default_device` holds for its own thread only.
    """
    device = jax.config.jax_default_device
    if device is None:
        return jax.default_backend()
    platform = device if isinstance(device, str) else device.platform
    return "gpu" if platform in ("cuda", "rocm") else platform
