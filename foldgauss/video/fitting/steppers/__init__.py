"""The steps of a fit: `protocol.Stepper` is what the loop calls; `cpu_stepper.CpuStepper` implements it with the Numba
kernels, `jax_stepper.JaxStepper` with one compiled JAX program per step for any device. `engines` chooses between them;
`loss` and `jax_loss` hold the training loss.
"""
