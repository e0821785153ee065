"""Independent helpers: argument checks, settings, threads, Numba kernels, signals and file locks."""
