"""The text that a fit's result shows."""

from soft_models import NUM, NUM_FRAMES, SIZE, soft_model

from foldgauss.video import FitInfo, FitResult


def test_fit_result():
    course = [FitInfo(step, step / 3, 0.1 / step, 20.0 + step, NUM, NUM, 0.5 * step, 1.0, None) for step in (1, 2, 3)]
    result = FitResult(soft_model(), course)
    of_what = f"{NUM_FRAMES} frames of {SIZE[0]}x{SIZE[1]}, {NUM} Gaussians"
    assert repr(result) == f"FitResult({of_what}; 23.00 dB after 3 steps, 1.5 s)"
    assert repr(FitResult(result.model, [])) == f"FitResult({of_what})"
