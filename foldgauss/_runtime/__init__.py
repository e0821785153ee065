"""Processes, threads and argument checks, independent of any model.

`checks.invalid` builds the errors of the whole package; `threads.run_tasks` runs work on the thread pool;
`kernels.kernel` compiles Numba kernels; `interrupts` and `machine` handle signals and the
description of the machine; `settings` documents and validates the fields of configurations.
"""
