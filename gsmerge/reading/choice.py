"""The value of a decision on files: which cameras, photos and masks are used or left out, and why."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmerge.frozen import dataclass
from gsmerge.reading.scene_files import SceneFiles
from gsmerge.settings.reading import NONE

OPTIONS = {"cameras": "--cameras", "photos": "--images", "masks": "--masks"}  # the option that names files of a kind
ESTIMATED_CAMERAS = "estimated"  # in place of the path of cameras that are estimated from the rows


@dataclass(frozen=True)
class Choice:
    """Whether cameras, photos or masks that may belong to a scene are used, and why."""

    kind: str  # "cameras", "photos" or "masks"
    path: str  # relative to the scene's folder if they lie in it; for what is no file, a word such as "estimated"
    chosen: bool
    reason: str  # in a few words, with the number that decided
    option: str  # what a user types to take them; empty if that would be refused, or would change nothing


def make_choice(
    files: SceneFiles, kind: str, place: Path | str, reason: str, *, chosen: bool, can_be_named: bool = True
) -> Choice:
    """Make the choice about a ``place``: a path, :data:`ESTIMATED_CAMERAS`, or words for what is no file of its own.

    ``can_be_named``: an option that names the place takes it.
    """
    root = files.root or files.ply.parent
    option = ""
    path = place.relative_to(root) if isinstance(place, Path) and place.is_relative_to(root) else place
    if can_be_named and (isinstance(place, Path) or place == ESTIMATED_CAMERAS):
        option = shlex.join([OPTIONS[kind], NONE if place == ESTIMATED_CAMERAS else str(place)])
    return Choice(kind, path.as_posix() if isinstance(path, Path) else path, chosen, reason, option)


def candidate_lines(choices: Sequence[Mapping[str, Any]]) -> list[str]:
    """Describe choices, as a document has them, in columns; the option stands where it would change the choice."""
    rows = [(one["kind"], one["path"], "chosen" if one["chosen"] else "left out") for one in choices]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = list[str]()
    for one, row in zip(choices, rows, strict=True):
        columns = "  ".join(f"{text:{width}}" for text, width in zip(row, widths, strict=True))
        option = "" if one["chosen"] or not one["option"] else f" ({one['option']})"
        lines.append(f"{columns}  {one['reason']}{option}")
    return lines
