"""Small models made by hand: some tens of smooth Gaussians, an object among them."""

import numpy as np

from foldgauss.envelope import TimeLikelihood
from foldgauss.render import RenderOptions
from foldgauss.video import FoldedSplats, FrameTimes, VideoModel

SIZE, NUM, NUM_FRAMES = (40, 64), 40, 7
#: The object: the first dozen, which stand about (-0.15, 0); all others are background.
OBJECT = np.arange(NUM) < 12


def soft_model(
    *, power=2.0, floor=0.0, options=None, size=SIZE, degree=3, seed=0, compositing="over", num_frames=NUM_FRAMES
) -> VideoModel:
    rng = np.random.default_rng(seed)

    def normal(*shape, scale=1.0):
        return (rng.normal(size=(NUM, *shape)) * scale).astype(np.float32)

    loc = np.where(OBJECT[:, None], np.array([-0.15, 0.0]) + normal(2, scale=0.04), normal(2, scale=0.25))
    splats = FoldedSplats(
        loc=loc.astype(np.float32),
        log_scale=np.where(OBJECT[:, None], -3.2, -2.2).astype(np.float32) + normal(2, scale=0.3),
        angle_logit=normal(),
        time_loc_logit=normal(scale=0.5),
        log_time_scale=normal(scale=0.2) - np.float32(0.5),
        coefficients=normal(degree, 2, scale=0.05),
        opacity_logit=normal(),
        color_dc=normal(3),
        envelope=TimeLikelihood(power, floor),
    )
    options = RenderOptions.exact() if options is None else options
    return VideoModel(splats, FrameTimes.uniform(num_frames), size, 25.0, options, compositing)
