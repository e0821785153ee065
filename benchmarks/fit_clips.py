"""Quality against time on footage: *bikes* (moving cameras, six shots) and *carphone*, each at its own size.

    python -m benchmarks.fit_clips [--minutes M] [--gaussians N] [--plot FILE] [... as benchmarks.fit_clip]

Without options: 5 minutes each, 120,000 Gaussians for *bikes* and half of that for *carphone*.
"""

import argparse

from benchmarks import _common, fit_clip

GAUSSIANS = {"bikes": 120_000, "carphone": 60_000}
MINUTES = 5.0


def main(arguments: list[str] | None = None) -> None:
    options = _common.parse(fit_clip._parser(), arguments)
    if options.steps is None and options.minutes is None:
        options.minutes = MINUTES
    figures, settings, courses = {}, {}, {}
    for clip, num in GAUSSIANS.items():
        own = argparse.Namespace(**vars(options) | {"clip": clip, "gaussians": options.gaussians or num})
        found, settings[clip], courses[clip] = fit_clip.measure(own)
        figures |= {f"{name}_{clip}": value for name, value in found.items()}
    if options.plot is not None:
        fit_clip.plot(courses, options.plot)
    _common.finish(options.json, figures, _common.describe_machine(), settings=settings, courses=courses)


if __name__ == "__main__":
    main()
