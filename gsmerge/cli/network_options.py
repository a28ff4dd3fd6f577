"""Options of the commands that use or train networks."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from gsmerge.cli.options import MERGING, Device


class Geometry(str, Enum):
    """What is matched where networks are loaded."""

    analytic = "analytic"
    decoded = "decoded"


GeometryOption = Annotated[
    Geometry | None,
    typer.Option(
        help="What is matched where networks are loaded: moments, or what the K = 1 head makes of them.",
        show_default="analytic",
        rich_help_panel=MERGING,
    ),
]
CheckpointOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|NAME",
        help="Trained networks that correct what the analytic stages make: a file, shipped, none, or auto: the "
        "shipped ones where they gain.",
        show_default="auto",
        rich_help_panel=MERGING,
    ),
]
RequireCheckpointOption = Annotated[
    bool,
    typer.Option(
        "--require-checkpoint",
        help="A checkpoint that cannot be used is an error, instead of a note.",
        rich_help_panel=MERGING,
    ),
]
TrainDeviceOption = Annotated[Device, typer.Option(help="Where the networks run; windows are rendered on the CPU.")]


def checkpoint_files(checkpoint: str | None) -> tuple[Path, ...]:
    """The file that ``--checkpoint`` names; none where it is a name of the package's own."""
    from gsmerge.options import CHECKPOINTS

    return () if checkpoint is None or checkpoint in CHECKPOINTS else (Path(checkpoint),)
