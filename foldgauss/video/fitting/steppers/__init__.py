"""The steps of a fit: `cpu_stepper.CpuStepper` computes them with the Numba kernels, `jax_stepper.JaxStepper` with one
compiled JAX program per step for any device. Both have the same methods, and `engines` chooses between them; `loss` and
`jax_loss` hold the training loss.
"""
