"""The registry of commands: the module of each, which is imported when it is called, and its summary."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Command(NamedTuple):
    """The module of `foldgauss.cli` that defines a command, and the first sentence of its help."""

    module: str
    summary: str


#: In the order in which users need them.
COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "fit": Command("fitting.fit", "Fit a model to a clip; the first of its budgets ends the fit."),
        "fit-many": Command(
            "fitting.fit_many", "Fit a compact model to each clip of a folder, and list those that fail."
        ),
        "view": Command("viewing.view", "Play and edit a model in the browser, until Ctrl-C."),
        "player": Command(
            "viewing.player", "Write the player without a model, as a static site: one page that opens model files."
        ),
        "render": Command("viewing.render", "Render a model as a video, also between its frames."),
        "stabilize": Command("viewing.stabilize", "Render a model as a steadier camera would show it."),
        "plate": Command(
            "viewing.plate", "Render a model without its moving object, with what other frames show behind it."
        ),
        "evaluate": Command("viewing.evaluate", "Compare a model with its clip: PSNR and SSIM of every frame."),
        "info": Command("viewing.info", "Show what a model file contains."),
        "figure": Command("viewing.figure", "Make a labeled figure of images from a model: PNG."),
        "uncertainty": Command(
            "measuring.uncertainty", "Estimate the uncertainty of the frame times, given the splats."
        ),
        "segment": Command("editing.edit", "Extract one segment of a model in segments as a model of its own."),
        "edit": Command("editing.edit", "Edit objects or single frames of a model by a script."),
        "compress": Command("editing.compress", "Write a model as a compact file, a fraction of its size."),
        "tradeoff": Command(
            "measuring.tradeoff", "Measure time, size and speed against quality, one setting at a time."
        ),
        "export": Command("editing.export", "Write a model for other programs, or as a web page."),
        "import": Command("editing.export", "Read a model of another program, see docs/formats.md."),
        "doctor": Command("measuring.doctor", "Check the installation: versions, devices, and a small fit."),
        "demo": Command("fitting.demo", "Fit 24 frames of the clip Bunny and show the results."),
    }
)
