"""What the program needs from its machine: argument checks, threads, Numba kernels, signals and file locks."""
