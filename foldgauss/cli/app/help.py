"""What `--help` shows: options in panels, and examples of every command below them."""

import inspect
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import typer
import typer.core
from rich.console import Console
from rich.markup import escape


class Example(NamedTuple):
    """What one wants, and the line that does it."""

    what: str
    line: str


#: By name of the command, as it is typed; "" is `foldgauss` alone.
EXAMPLES: Mapping[str, tuple[Example, ...]] = MappingProxyType(
    {
        "": (
            Example("See what it does, on a clip that comes along", "foldgauss demo"),
            Example("Fit a model to a clip of your own", "foldgauss fit holiday.mp4"),
            Example("Look whether all works on this machine", "foldgauss doctor"),
            Example("Complete commands, options and files by the Tab key", "foldgauss --install-completion"),
        ),
        "fit": (
            Example("Everything by default, into holiday.safetensors", "foldgauss fit holiday.mp4"),
            Example(
                "A first look: half a second of it, small", "foldgauss fit holiday.mp4 --preset draft --frames 0:12"
            ),
            Example(
                "The best that five minutes give, at 160x320 pixels",
                "foldgauss fit holiday.mp4 --size 160x320 --minutes 5",
            ),
            Example("A small file that is good enough", "foldgauss fit holiday.mp4 --economy --max-size-mb 2"),
            Example("Frames as images; go on with a fit that was stopped", "foldgauss fit frames/ --resume"),
            Example("For slow motion", "foldgauss fit holiday.mp4 --interpolation-fraction 0.5"),
            Example("A long clip, in segments of 10 seconds, by four processes", "foldgauss fit film.mp4 --workers 4"),
            Example(
                "The same by a cluster of dask, whose workers see these folders",
                "foldgauss fit film.mp4 --scheduler tcp://node1:8786",
            ),
        ),
        "fit-many": (
            Example("A model of each clip, into holidays-models", "foldgauss fit-many holidays/"),
            Example(
                "By four processes, small; the same again does what is left",
                "foldgauss fit-many holidays/ --out models --size 160x320 --workers 4",
            ),
        ),
        "demo": (Example("Fit, play and judge the clip Bunny", "foldgauss demo --out first-look"),),
        "render": (
            Example("As a video, holiday.mp4", "foldgauss render holiday.safetensors"),
            Example(
                "Four times as smooth, four times as many frames", "foldgauss render holiday.safetensors --upsample 4"
            ),
            Example(
                "Slow motion as an animation",
                "foldgauss render holiday.safetensors --speed 0.25 --out slow.gif",
            ),
            Example(
                "One picture, twice the size",
                "foldgauss render holiday.safetensors --times 0.5 --size 320x640 --out one.png",
            ),
            Example("Exact frames, in a folder", "foldgauss render holiday.safetensors --out frames"),
        ),
        "view": (
            Example("Play it in the browser", "foldgauss view holiday.safetensors"),
            Example("Beside the clip", "foldgauss view holiday.safetensors --original holiday.mp4"),
        ),
        "evaluate": (
            Example("PSNR and SSIM of every frame", "foldgauss evaluate holiday.safetensors holiday.mp4"),
            Example("For other programs", "foldgauss evaluate holiday.safetensors holiday.mp4 --json holiday.json"),
        ),
        "info": (Example("What is in the file", "foldgauss info holiday.safetensors"),),
        "segment": (
            Example("The fourth, into holiday.3.safetensors", "foldgauss segment holiday.safetensors 3"),
            Example("With another name", "foldgauss segment holiday.safetensors 0 --out beginning.safetensors"),
        ),
        "edit": (
            Example(
                "Into holiday.night.safetensors, by the script night.toml",
                "foldgauss edit holiday.safetensors night.toml",
            ),
            Example("At once into a video", "foldgauss edit holiday.safetensors night.toml --out night.mp4"),
        ),
        "compress": (
            Example("Into holiday.fgz, without the clip", "foldgauss compress holiday.safetensors"),
            Example("Smaller, with the clip", "foldgauss compress holiday.safetensors holiday.mp4"),
            Example(
                "Smaller still, for half a dB",
                "foldgauss compress holiday.safetensors holiday.mp4 --max-loss-db 0.5",
            ),
            Example("Half the bytes in no time", "foldgauss compress holiday.safetensors --float16"),
        ),
        "export": (
            Example("As a page that plays it, holiday.html", "foldgauss export holiday.safetensors --format html"),
            Example("For VeGaS, into holiday.ply", "foldgauss export holiday.safetensors --format ply"),
            Example(
                "One frame for a viewer of 3DGS scenes",
                "foldgauss export holiday.safetensors --format ply3dgs --times 0.5 --out one.ply",
            ),
            Example(
                "Every frame as triangles, to be edited elsewhere",
                "foldgauss export holiday.safetensors --format obj --out mesh",
            ),
        ),
        "import": (
            Example("A model of VeGaS, into video.safetensors", "foldgauss import video.ply"),
            Example("Frames edited as triangles, into mesh.mp4", "foldgauss import mesh/ --fps 24"),
        ),
        "figure": (
            Example("What lies between two frames", "foldgauss figure interpolation holiday.safetensors"),
            Example(
                "Frames, reconstructions and errors",
                "foldgauss figure reconstruction holiday.safetensors holiday.mp4",
            ),
        ),
        "figure interpolation": (
            Example("Near the middle, into a PNG", "foldgauss figure interpolation holiday.safetensors"),
            Example(
                "After frames 12 and 40",
                "foldgauss figure interpolation holiday.safetensors --at 12,40 --width 320",
            ),
        ),
        "figure reconstruction": (
            Example("Three frames, into a PNG", "foldgauss figure reconstruction holiday.safetensors holiday.mp4"),
            Example(
                "Those one names",
                "foldgauss figure reconstruction holiday.safetensors holiday.mp4 --at 0,30",
            ),
        ),
        "uncertainty": (
            Example(
                "Tables and pictures into holiday-uncertainty",
                "foldgauss uncertainty holiday.safetensors holiday.mp4",
            ),
            Example(
                "Of frames 10 to 19 alone, with the colours unknown",
                "foldgauss uncertainty holiday.safetensors holiday.mp4 --only 10:20 --level colors",
            ),
        ),
        "tradeoff": (
            Example("In ten minutes, into holiday-tradeoff", "foldgauss tradeoff holiday.mp4"),
            Example(
                "What time and degree buy, on a small clip, in two",
                "foldgauss tradeoff holiday.mp4 --axes time,degree --size 80x160 --minutes 2",
            ),
        ),
        "doctor": (
            Example("What is here, and whether it works", "foldgauss doctor"),
            Example("For a report of an error", "foldgauss doctor --json > doctor.json"),
        ),
    }
)


class Command(typer.core.TyperCommand):
    """A command whose help has examples."""

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        _as_plain_text(self)

    def format_help(self, ctx, formatter) -> None:
        _show_help(self, ctx)


class Group(typer.core.TyperGroup):
    """A group whose help has examples."""

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        _as_plain_text(self)

    def format_help(self, ctx, formatter) -> None:
        _show_help(self, ctx)


class App(typer.Typer):
    """A Typer whose commands show their options in panels, and examples."""

    def __init__(self, **options: Any):
        # Without markup errors stay on one line; help has its own way, below.
        super().__init__(**({"cls": Group} | options), rich_markup_mode=None)

    def command(self, name: str | None = None, **options: Any) -> Callable:
        return super().command(name, **({"cls": Command} | options))


def _as_plain_text(command: "Command | Group") -> None:
    """Brackets are no markup in our texts, and the ends of source lines no ends of lines."""
    paragraphs = inspect.cleandoc(command.help or "").split("\n\n")
    command.help = escape("\n\n".join(" ".join(one.split()) for one in paragraphs))
    for parameter in command.params:
        if getattr(parameter, "help", None):
            parameter.help = escape(parameter.help)


def _show_help(command: "Command | Group", ctx) -> None:
    from typer import rich_utils  # for help alone: it brings a reader of Markdown

    rich_utils.rich_format_help(obj=command, ctx=ctx, markup_mode="rich")
    console = Console(markup=False, highlight=False)
    examples = EXAMPLES.get(ctx.command_path.partition(" ")[2], ())
    if examples:
        console.print(" Examples", style="bold")
    for example in examples:
        console.print(f"   {example.what}:", style="dim")
        console.print(f"     {example.line}", style="cyan", soft_wrap=True)
