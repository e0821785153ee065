"""The registry of commands: the module of each, which is imported when it is called, its summary and its examples."""

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
        "view": Command("viewing.view", "Play and edit a model in the browser, or write the page that does."),
        "render": Command(
            "viewing.render", "Render a model as a video: also between its frames, stabilized, or some of its layers."
        ),
        "evaluate": Command("viewing.evaluate", "Compare a model with its clip: PSNR and SSIM of every frame."),
        "info": Command("viewing.info", "Show what a model file contains."),
        "uncertainty": Command(
            "measuring.uncertainty", "Estimate the uncertainty of the frame times, given the splats."
        ),
        "edit": Command("editing.edit", "Edit objects or single frames of a model by a script."),
        "compress": Command("editing.compress", "Write a model as a compact file, a fraction of its size."),
        "tradeoff": Command(
            "measuring.tradeoff", "Measure time, size and speed against quality, one setting at a time."
        ),
        "export": Command("editing.export", "Write a model for other programs, or a part of it as a model."),
        "import": Command("editing.export", "Read a model of another program, see docs/formats.md."),
        "demo": Command("fitting.demo", "Fit 24 frames of the clip Bunny and show the results."),
    }
)

#: Purposes and the command lines that serve them, shown in the help, by the name of the command as it is typed; "" is
#: `foldgauss` alone.
EXAMPLES: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "": {
            "See what it does, on a sample clip": "foldgauss demo",
            "Fit a model to your own clip": "foldgauss fit holiday.mp4",
            "Install shell completion": "foldgauss --install-completion",
        },
        "fit": {
            "All defaults, into holiday.fgz": "foldgauss fit holiday.mp4",
            "A quick draft of the first half second": "foldgauss fit holiday.mp4 --preset draft --frames 0:12",
            "A file of a given size": "foldgauss fit holiday.mp4 --size-mb 2",
            "Frames as images": "foldgauss fit frames/",
            "For slow motion above all": "foldgauss fit holiday.mp4 --interpolation-fraction 0.3 --interpolation-end 1",
            "A long clip, in segments of 10 seconds, with four processes": "foldgauss fit film.mp4 --workers 4",
        },
        "fit-many": {
            "A model per clip, into holidays-models": "foldgauss fit-many holidays/",
            "With four processes, at a small size; run it again to continue": (
                "foldgauss fit-many holidays/ --out models --size 160x320 --workers 4"
            ),
        },
        "demo": {
            "Fit, render and evaluate the clip Bunny": "foldgauss demo --out first-look",
        },
        "render": {
            "As a video, holiday.mp4": "foldgauss render holiday.fgz",
            "At 100 frames per second": "foldgauss render holiday.fgz --fps 100",
            "Slow motion as an animation": "foldgauss render holiday.fgz --speed 0.25 --out slow.gif",
            "One image at twice the size": "foldgauss render holiday.fgz --times 0.5 --size 320x640 --out one.png",
            "Lossless frames, in a folder": "foldgauss render holiday.fgz --out frames",
            "Stabilized, into holiday.stable.mp4": "foldgauss render holiday.fgz --stabilize smooth",
            "As from a tripod, borders filled from other frames": (
                "foldgauss render holiday.fgz --stabilize fixed --border fill"
            ),
            "Without the objects of a fit with masks, into layers.background.mp4": (
                "foldgauss render layers.fgz --layer background"
            ),
            "One object alone, with alpha": "foldgauss render layers.fgz --layer object --background none --out cutout",
        },
        "view": {
            "Play it in the browser": "foldgauss view holiday.fgz",
            "Next to the clip": "foldgauss view holiday.fgz --original holiday.mp4",
            "As a web page, to be sent or hosted": "foldgauss view holiday.fgz --out holiday.html",
            "The page without a model, which opens model files": "foldgauss view --out index.html",
        },
        "evaluate": {
            "PSNR and SSIM of every frame": "foldgauss evaluate holiday.fgz holiday.mp4",
            "As JSON": "foldgauss evaluate holiday.fgz holiday.mp4 --json holiday.json",
        },
        "info": {
            "Show the contents of the file": "foldgauss info holiday.fgz",
        },
        "edit": {
            "With the script night.toml, into holiday.night.safetensors": "foldgauss edit holiday.fgz night.toml",
            "Render the edited video directly": "foldgauss edit holiday.fgz night.toml --out night.mp4",
        },
        "compress": {
            "Into holiday.fgz, without the clip": "foldgauss compress holiday.safetensors",
            "Smaller, with the clip": "foldgauss compress holiday.safetensors holiday.mp4",
            "With a quality": "foldgauss compress holiday.safetensors holiday.mp4 --quality 60",
        },
        "export": {
            "For VeGaS, into holiday.ply": "foldgauss export holiday.fgz --format ply",
            "One frame for a viewer of 3DGS scenes": (
                "foldgauss export holiday.fgz --format ply3dgs --times 0.5 --out one.ply"
            ),
            "Every frame as triangles, to edit elsewhere": "foldgauss export holiday.fgz --format obj --out mesh",
            "The fourth segment as a model, film.3.safetensors": "foldgauss export film.fgz --format model --segment 3",
        },
        "import": {
            "A VeGaS model, into video.safetensors": "foldgauss import video.ply",
        },
        "uncertainty": {
            "Tables and figures into steady-uncertainty, of a model that was fitted with --no-follow-camera": (
                "foldgauss uncertainty steady.safetensors holiday.mp4"
            ),
        },
        "tradeoff": {
            "In ten minutes, into holiday-tradeoff": "foldgauss tradeoff holiday.mp4",
            "Only time and degree, at a small size, in two minutes": (
                "foldgauss tradeoff holiday.mp4 --axes time,degree --size 80x160 --minutes 2"
            ),
        },
    }
)
