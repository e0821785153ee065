"""Edits that a folded model can hold, and pictures to compare them by."""

import numpy as np
from soft_models import soft_model

from foldgauss.video.models.renderer import VideoRenderer

TIMES = np.asarray(soft_model().frame_times.times())


ALWAYS = {"frames": (None, None)}  # as an overlay


BETWEEN = (0.0, 0.31, float(TIMES[3]), 0.77, 1.0)


def picture(video, t, size=None) -> np.ndarray:
    return np.array(VideoRenderer(video, size).image(t))


def apart(one, other, t) -> float:
    return float(np.abs(picture(one, t) - picture(other, t)).max())


TURN = 0.6


MAPS = {
    "move": lambda e, **when: e.move((0.12, -0.05), **when),
    "scale": lambda e, **when: e.scale(1.4, about=(0.05, 0.1), **when),
    "scale two ways": lambda e, **when: e.scale((1.5, 0.7), about=(-0.1, 0.0), **when),
    "rotate": lambda e, **when: e.rotate(TURN, about=(0.1, 0.05), **when),
    "shear": lambda e, **when: e.transform([[1.1, 0.4], [-0.2, 0.8]], (0.02, 0.03), about=(0, 0), **when),
    "mirror": lambda e, **when: e.transform([[-1, 0.1], [0, 1]], about=(-0.1, 0.0), **when),
}


BAKED = MAPS | {
    "opacity": lambda e, **when: e.opacity(0.4, **when),
    "more opacity": lambda e, **when: e.opacity(1.1, **when),
    "gain": lambda e, **when: e.recolor(gain=(0.5, 1.5, 1), offset=-0.1, **when),
    "matrix": lambda e, **when: e.recolor(matrix=np.eye(3)[[1, 2, 0]], **when),
    "color": lambda e, **when: e.recolor((0.9, 0.2, 0.1), **when),
    "hue": lambda e, **when: e.recolor(hue=0.6, **when),
    "vanish": lambda e, **when: e.vanish(**when),
    "later": lambda e, **when: e.retime(shift=0.04, stretch=1.2, about=0.5, **when),
    "slower": lambda e, **when: e.retime(stretch=1.2, about=0.5, **when),
    "reverse": lambda e, **when: e.retime(stretch=-1, about=0.5, **when),
    "multiply": lambda e, **when: e.multiply([(0.2, 0.1), (0.1, -0.1)], about=(0, 0), scale=(0.8, 1.2), **when),
}
