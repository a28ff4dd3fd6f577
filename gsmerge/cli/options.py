"""The options that commands share, each declared once. Names are the fields' names of the Python API.

An option that was not given is None and leaves the library's own default alone; ``show_default`` repeats that
default for the reader, and a test holds the two together.
"""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

INPUT, SEGMENTATION, COUNT, MERGING, MEASURING, OUTPUT = (
    "Input",
    "Superpixels",
    "How many Gaussians",
    "Merging and colours",
    "Measuring",
    "Output and behaviour",
)


class Segmentation(str, Enum):
    """Ways to cut superpixels."""

    rdseg = "rdseg"
    bass = "bass"
    bass_st = "bass-st"
    slic = "slic"
    grid = "grid"


class Method(str, Enum):
    """Our own method and its rivals."""

    gsmerge = "gsmerge"
    unmerged = "unmerged"
    unmerged_color = "unmerged-color"
    unmerged_fit = "unmerged-fit"
    paper = "paper"
    voxel = "voxel"
    opacity = "opacity"
    contribution = "contribution"
    random = "random"
    blocks = "blocks"
    greedy = "greedy"
    splat_transform = "splat-transform"


class Effort(str, Enum):
    """How much work to put in."""

    draft = "draft"
    fast = "fast"
    default = "default"
    best = "best"


class Preset(str, Enum):
    """Devices and the most Gaussians that they draw fluidly."""

    quest3 = "quest3"
    mobile = "mobile"
    desktop = "desktop"


class Match(str, Enum):
    """How Feature Gaussians of different views are told to show the same surface."""

    overlap = "overlap"
    aabb = "aabb"
    none = "none"


class Unseen(str, Enum):
    """Choices of ``--unseen``."""

    drop = "drop"
    keep = "keep"


class Fit(str, Enum):
    """What is fitted to the input images."""

    full = "full"
    color = "color"
    none = "none"


class Device(str, Enum):
    """Where the full fit runs."""

    cpu = "cpu"
    cuda = "cuda"
    auto = "auto"


class Opacity(str, Enum):
    """How the file stores opacity."""

    auto = "auto"
    logit = "logit"
    raw = "raw"


class Quats(str, Enum):
    """How the file stores rotations."""

    auto = "auto"
    wxyz = "wxyz"
    xyzw = "xyzw"
    xyzw_root = "xyzw-root"
    camera = "camera"


class Order(str, Enum):
    """Order of the file's rows."""

    auto = "auto"
    view_major = "view-major"
    view_fastest = "view-fastest"
    layer_major = "layer-major"
    column_major = "column-major"
    unordered = "unordered"
    none = "none"


class Lpips(str, Enum):
    """Networks of ``--lpips``."""

    both = "both"
    vgg = "vgg"
    alex = "alex"
    none = "none"


def debug_wanted() -> bool:
    """Whether the command line asked for tracebacks."""
    return _state["debug"]


def set_debug(value: bool) -> bool:
    """Remember ``--debug`` for the error handler, which runs when no command is active any more."""
    _state["debug"] = value
    return value


_state = {"debug": False}


SceneArgument = Annotated[
    Path, typer.Argument(metavar="SCENE", help="A .ply with one Gaussian per pixel and view, or the folder it is in.")
]
CamerasOption = Annotated[
    Path | None,
    typer.Option(
        help="Cameras: transforms.json, a COLMAP folder, cameras.json or results.npz. Found beside the .ply if not"
        " given.",
        rich_help_panel=INPUT,
    ),
]
ImagesOption = Annotated[
    Path | None,
    typer.Option(help="Folder of the input images. Found beside the .ply if not given.", rich_help_panel=INPUT),
]
OpacityOption = Annotated[
    Opacity,
    typer.Option(
        help="How the file stores opacity: as logits, or raw in [0, 1]; auto looks at the values.",
        rich_help_panel=INPUT,
    ),
]
DialectOption = Annotated[
    str,
    typer.Option(
        help="Which exporter wrote the file, such as da3 or depthsplat; auto recognises it.", rich_help_panel=INPUT
    ),
]
QuatsOption = Annotated[
    Quats,
    typer.Option(
        help="How the file stores rotations: w first, w last, or relative to each view's camera.",
        rich_help_panel=INPUT,
    ),
]
OrderOption = Annotated[
    Order,
    typer.Option(help="Order of the rows; none: they belong to no pixels.", rich_help_panel=INPUT),
]
SceneScaleOption = Annotated[
    float | None,
    typer.Option(
        help="Size of the Gaussians' world in units of the cameras'.", show_default="found", rich_help_panel=INPUT
    ),
]
TargetsOption = Annotated[
    Path | None,
    typer.Option(
        help="Cameras of held-out photos: any camera file; views that the scene was made of are left out.",
        rich_help_panel=INPUT,
    ),
]
TargetImagesOption = Annotated[
    Path | None,
    typer.Option(help="Folder of the held-out photos. Found by their cameras if not given.", rich_help_panel=INPUT),
]
LpipsOption = Annotated[
    Lpips | None,
    typer.Option(
        help="Networks of the perceptual distance; none is much faster.",
        show_default="both, where installed",
        rich_help_panel=MEASURING,
    ),
]
MaxSideOption = Annotated[
    int | None,
    typer.Option(
        min=16,
        help="Longest side of the views of Gaussians that belong to no pixels; larger photos are resized.",
        show_default="1200",
        rich_help_panel=INPUT,
    ),
]
SuperpixelsOption = Annotated[
    int | None,
    typer.Option(min=1, help="Superpixels per view. Wins over --density.", rich_help_panel=SEGMENTATION),
]
DensityOption = Annotated[
    float | None,
    typer.Option(min=0.0, max=1.0, help="Superpixels per pixel.", show_default="0.044", rich_help_panel=SEGMENTATION),
]
SegmentationOption = Annotated[
    Segmentation | None,
    typer.Option(help="How superpixels are cut.", show_default="rdseg", rich_help_panel=SEGMENTATION),
]
EffortOption = Annotated[
    Effort | None,
    typer.Option(
        help="How much work to put into superpixels and fit.", show_default="default", rich_help_panel=SEGMENTATION
    ),
]


def parse_k(text: str) -> int | str:
    """``--k``: a number from 1 to 8, or auto."""
    if text == "auto":
        return text
    if not text.isdigit() or not 1 <= int(text) <= 8:
        raise typer.BadParameter(f'expected 1 to 8 or "auto", got {text!r}')
    return int(text)


KOption = Annotated[
    str | None,
    typer.Option(
        "--k",
        parser=parse_k,
        metavar="[1-8|auto]",
        help="Gaussians per superpixel: finer with more. auto: as many as the scene needs.",
        show_default="1",
        rich_help_panel=COUNT,
    ),
]
BudgetOption = Annotated[
    str | None,
    typer.Option(help='Gaussians in the result, such as 40000 or "2%"; met exactly.', rich_help_panel=COUNT),
]
MaxBytesOption = Annotated[
    str | None, typer.Option(help="Largest size of the result as a .ply, such as 5MB.", rich_help_panel=COUNT)
]
PresetOption = Annotated[
    Preset | None,
    typer.Option(help="At most as many Gaussians as this device draws fluidly.", rich_help_panel=COUNT),
]
MaxDropOption = Annotated[
    float | None,
    typer.Option(
        min=0.0, help="Fewest Gaussians within so many dB of the best that the scene reaches.", rich_help_panel=COUNT
    ),
]
TargetPsnrOption = Annotated[
    float | None,
    typer.Option(min=0.0, help="Fewest Gaussians that render the input images at so many dB.", rich_help_panel=COUNT),
]
LevelsOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=8,
        help="Levels of detail, each in a file of its own, with a quarter of the Gaussians of the one before.",
        show_default="1",
        rich_help_panel=COUNT,
    ),
]
FitStepsOption = Annotated[
    int | None,
    typer.Option(
        min=1, help="Steps of the full fit: more takes longer.", show_default="by effort", rich_help_panel=MERGING
    ),
]
TimeBudgetOption = Annotated[
    float | None, typer.Option(min=0.0, help="Seconds that the full fit may take.", rich_help_panel=MERGING)
]
DeviceOption = Annotated[
    Device | None,
    typer.Option(
        help="Where the full fit runs; cuda needs gsmerge[cuda]. auto: a GPU where there is one.",
        show_default="cpu",
        rich_help_panel=MERGING,
    ),
]
RobustOption = Annotated[
    bool | None,
    typer.Option(
        "--robust/--no-robust",
        help="Choose among merges by what the photos say.",
        show_default="unless --fit full or a draft",
        rich_help_panel=MERGING,
    ),
]
MatchOption = Annotated[
    Match | None,
    typer.Option(help="Merging across views.", show_default="overlap, none for a draft", rich_help_panel=MERGING),
]
FitOption = Annotated[
    Fit | None, typer.Option(help="What to fit to the photos.", show_default="full", rich_help_panel=MERGING)
]
MethodOption = Annotated[
    Method | None,
    typer.Option(
        help="What makes the result: gsmerge, or another method to compare it with.",
        show_default="gsmerge",
        rich_help_panel=MERGING,
    ),
]
UnseenOption = Annotated[
    Unseen | None,
    typer.Option(
        help="Gaussians that no view sees, where they are not one per pixel: drop (the default), or keep, merged.",
        rich_help_panel=MERGING,
    ),
]
OutputOption = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        help="The compact scene: .ply, .compressed.ply, .spz or .splat, by its name.",
        show_default="SCENE.compact.ply",
        rich_help_panel=OUTPUT,
    ),
]
SeedOption = Annotated[
    int | None, typer.Option(min=0, help="Seed of everything random.", show_default="0", rich_help_panel=OUTPUT)
]
ReportOption = Annotated[Path | None, typer.Option(help="Write the JSON report to this file.", rich_help_panel=OUTPUT)]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Print what would be done; write nothing.", rich_help_panel=OUTPUT)
]
ThreadsOption = Annotated[
    int | None,
    typer.Option(
        min=1, help="Threads. The result is the same for any.", show_default="all processors", rich_help_panel=OUTPUT
    ),
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace the output if it exists.", rich_help_panel=OUTPUT)
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Errors only.", rich_help_panel=OUTPUT)]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON on stdout.", rich_help_panel=OUTPUT)]
DebugOption = Annotated[
    bool,
    typer.Option("--debug", help="Tracebacks for errors.", callback=set_debug, is_eager=True, rich_help_panel=OUTPUT),
]
