"""The commands: in which module each stands, and what the list of them says of it. Imported when one is called."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Command(NamedTuple):
    """The module of `foldgauss.cli` that adds a command, and the first sentence of its help."""

    module: str
    what: str


#: As one comes to need them.
COMMANDS: Mapping[str, Command] = MappingProxyType(
    {
        "fit": Command("fitting.fit", "Fit a model to a clip; the first of its budgets ends it."),
        "fit-many": Command(
            "fitting.many", "Fit a model to each clip of a folder; those that cannot be fitted are listed."
        ),
        "view": Command("view", "Play a model in the browser; Ctrl-C ends it."),
        "render": Command("render", "Draw a model as a video, in between its frames too."),
        "evaluate": Command("render", "Compare a model with its clip: PSNR and SSIM of every frame."),
        "info": Command("render", "Say what a model file holds."),
        "figure": Command("figure", "Make a labelled picture of pictures from a model: PNG."),
        "uncertainty": Command("uncertainty", "Say how sure the frame times are, given the splats."),
        "segment": Command("edit", "Take one segment out of a model in segments, as a model of its own."),
        "edit": Command("edit", "Edit objects or single frames of a model by a script."),
        "compress": Command("compress", "Write a model as a compact file: a fraction of its size."),
        "tradeoff": Command("tradeoff", "Measure what speed and size cost, one setting at a time."),
        "export": Command("edit", "Write a model for other programs, or a page."),
        "import": Command("edit", "Read what another program made: see docs/formats.md."),
        "doctor": Command(
            "doctor",
            "Look at what is installed and try it: some seconds, more where kernels are compiled for the first time.",
        ),
        "demo": Command("fitting.fit", "Fit 24 frames of the clip Bunny and show what comes out."),
    }
)
