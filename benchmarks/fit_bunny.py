"""Quality against time on the paper's Bunny: `benchmarks.fit_clip` of all its frames.

    python -m benchmarks.fit_bunny [--size HxW] [--minutes M] [--gaussians N] [... as benchmarks.fit_clip]

Without options: 160x320, 40,000 Gaussians, 2 minutes.
"""

import sys

from benchmarks import fit_clip


def main(arguments: list[str] | None = None) -> None:
    fit_clip.main(["--clip", "bunny", *(sys.argv[1:] if arguments is None else arguments)])


if __name__ == "__main__":
    main()
