"""Fitting a video model to frames: initialization, optimization steps, densification and pruning.

`loop.fit` fits frames and `loop.fit_steps` yields every step of it; `config.FitConfig` holds the settings. A
`state.FitState` is what a step consumes; `steppers` compute the steps, `densify` and `pruning` change the number of
Gaussians, `schedule` and `budget` plan the steps, and `divergence` restores a fit that diverged.
"""
