"""Examples of every command, shown in its help."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Example(NamedTuple):
    """A purpose, and the command line that serves it."""

    purpose: str
    line: str


#: By the name of the command as it is typed; "" is `foldgauss` alone.
EXAMPLES: Mapping[str, tuple[Example, ...]] = MappingProxyType(
    {
        "": (
            Example("See what it does, on a sample clip", "foldgauss demo"),
            Example("Fit a model to your own clip", "foldgauss fit holiday.mp4"),
            Example("Check the installation", "foldgauss doctor"),
            Example("Install shell completion", "foldgauss --install-completion"),
        ),
        "fit": (
            Example("All defaults, into holiday.fgz", "foldgauss fit holiday.mp4"),
            Example("A quick draft of the first half second", "foldgauss fit holiday.mp4 --preset draft --frames 0:12"),
            Example(
                "Five minutes, at 160x320 pixels",
                "foldgauss fit holiday.mp4 --size 160x320 --minutes 5",
            ),
            Example("A small file", "foldgauss fit holiday.mp4 --size-mb 2"),
            Example("Frames as images; resume a stopped fit", "foldgauss fit frames/ --resume"),
            Example(
                "For slow motion above all",
                "foldgauss fit holiday.mp4 --interpolation-fraction 0.3 --interpolation-end 1",
            ),
            Example(
                "A long clip, in segments of 10 seconds, with four processes", "foldgauss fit film.mp4 --workers 4"
            ),
            Example(
                "The same on a dask cluster whose workers see these folders",
                "foldgauss fit film.mp4 --scheduler tcp://node1:8786",
            ),
        ),
        "fit-many": (
            Example("A model per clip, into holidays-models", "foldgauss fit-many holidays/"),
            Example(
                "With four processes, at a small size; run it again to continue",
                "foldgauss fit-many holidays/ --out models --size 160x320 --workers 4",
            ),
        ),
        "demo": (Example("Fit, render and evaluate the clip Bunny", "foldgauss demo --out first-look"),),
        "render": (
            Example("As a video, holiday.mp4", "foldgauss render holiday.safetensors"),
            Example(
                "Four times as many frames, four times the frame rate",
                "foldgauss render holiday.safetensors --upsample 4",
            ),
            Example(
                "Slow motion as an animation",
                "foldgauss render holiday.safetensors --speed 0.25 --out slow.gif",
            ),
            Example(
                "One image at twice the size",
                "foldgauss render holiday.safetensors --times 0.5 --size 320x640 --out one.png",
            ),
            Example("Lossless frames, in a folder", "foldgauss render holiday.safetensors --out frames"),
        ),
        "stabilize": (
            Example("As a smooth pan, into holiday.stable.mp4", "foldgauss stabilize holiday.safetensors"),
            Example(
                "As from a tripod, borders filled from other frames",
                "foldgauss stabilize holiday.safetensors --fixed --border fill",
            ),
        ),
        "player": (Example("The page without a model, to be hosted", "foldgauss player --out site"),),
        "view": (
            Example("Play it in the browser", "foldgauss view holiday.safetensors"),
            Example("Next to the clip", "foldgauss view holiday.safetensors --original holiday.mp4"),
        ),
        "plate": (
            Example("Without the moving object, into holiday.plate.mp4", "foldgauss plate holiday.safetensors"),
            Example("And its masks", "foldgauss plate holiday.safetensors --out empty.mp4 --save-masks masks"),
            Example("With masks of your own", "foldgauss plate holiday.safetensors --out mine.mp4 --masks masks"),
        ),
        "evaluate": (
            Example("PSNR and SSIM of every frame", "foldgauss evaluate holiday.safetensors holiday.mp4"),
            Example("As JSON", "foldgauss evaluate holiday.safetensors holiday.mp4 --json holiday.json"),
        ),
        "info": (Example("Show the contents of the file", "foldgauss info holiday.safetensors"),),
        "segment": (
            Example("The fourth, into holiday.3.safetensors", "foldgauss segment holiday.safetensors 3"),
            Example("With a name of your own", "foldgauss segment holiday.safetensors 0 --out beginning.safetensors"),
        ),
        "edit": (
            Example(
                "With the script night.toml, into holiday.night.safetensors",
                "foldgauss edit holiday.safetensors night.toml",
            ),
            Example(
                "Render the edited video directly", "foldgauss edit holiday.safetensors night.toml --out night.mp4"
            ),
        ),
        "compress": (
            Example("Into holiday.fgz, without the clip", "foldgauss compress holiday.safetensors"),
            Example("Smaller, with the clip", "foldgauss compress holiday.safetensors holiday.mp4"),
            Example(
                "Smaller still, at a lower quality",
                "foldgauss compress holiday.safetensors holiday.mp4 --quality 40",
            ),
        ),
        "export": (
            Example("As a web page with a player, holiday.html", "foldgauss export holiday.safetensors --format html"),
            Example("For VeGaS, into holiday.ply", "foldgauss export holiday.safetensors --format ply"),
            Example(
                "One frame for a viewer of 3DGS scenes",
                "foldgauss export holiday.safetensors --format ply3dgs --times 0.5 --out one.ply",
            ),
            Example(
                "Every frame as triangles, to edit elsewhere",
                "foldgauss export holiday.safetensors --format obj --out mesh",
            ),
        ),
        "import": (
            Example("A VeGaS model, into video.safetensors", "foldgauss import video.ply"),
            Example("Frames edited as triangles, into mesh.mp4", "foldgauss import mesh/ --fps 24"),
        ),
        "figure": (
            Example("Interpolation between two frames", "foldgauss figure interpolation holiday.safetensors"),
            Example(
                "Frames, reconstructions and errors",
                "foldgauss figure reconstruction holiday.safetensors holiday.mp4",
            ),
        ),
        "figure interpolation": (
            Example("Near the middle of the clip", "foldgauss figure interpolation holiday.safetensors"),
            Example(
                "After frames 12 and 40",
                "foldgauss figure interpolation holiday.safetensors --at 12,40 --width 320",
            ),
        ),
        "figure reconstruction": (
            Example("Three frames, evenly spaced", "foldgauss figure reconstruction holiday.safetensors holiday.mp4"),
            Example(
                "Chosen frames",
                "foldgauss figure reconstruction holiday.safetensors holiday.mp4 --at 0,30",
            ),
        ),
        "uncertainty": (
            Example(
                "Tables and figures into steady-uncertainty, of a model that was fitted with --no-follow-camera",
                "foldgauss uncertainty steady.safetensors holiday.mp4",
            ),
            Example(
                "Frames 10 to 19 only, with unknown colors",
                "foldgauss uncertainty steady.safetensors holiday.mp4 --only 10:20 --level colors",
            ),
        ),
        "tradeoff": (
            Example("In ten minutes, into holiday-tradeoff", "foldgauss tradeoff holiday.mp4"),
            Example(
                "Only time and degree, at a small size, in two minutes",
                "foldgauss tradeoff holiday.mp4 --axes time,degree --size 80x160 --minutes 2",
            ),
        ),
        "doctor": (
            Example("Show versions and devices, and try a fit", "foldgauss doctor"),
            Example("For a bug report", "foldgauss doctor --json > doctor.json"),
        ),
    }
)
