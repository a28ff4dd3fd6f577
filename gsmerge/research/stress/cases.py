"""The cases: what is changed, for which scenes, and the property that must hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from gsmerge.io.cameras.camera_file import CONVENTIONS
from gsmerge.research.stress import changes
from gsmerge.research.stress.changes import Judged

Needs = Literal["anything", "pixels", "photos", "file"]
Check = Literal["better", "same", "near", "once", "bits", "again", "convention"]

UTM = (4.0e5, 5.0e6, 100.0)

PROPERTIES: dict[Check, str] = {
    "better": "not below its own input by more than {worse:g} dB",
    "same": "as many Gaussians within 0.5 %, not more than {same:g} dB below the unchanged scene",
    "near": "not more than {near:g} dB below the unchanged scene",
    "once": "at most 1.05 times the Gaussians, not more than {same:g} dB below the unchanged scene",
    "bits": "the same result, bit for bit",
    "again": "compacted again to the same count, not more than {same:g} dB below",
    "convention": "recognised, with every Gaussian at its pixel, or refused in one line",
}


@dataclass(frozen=True)
class Case:
    """One way to make life hard.

    Args:
        name: On the command line.
        words: What is changed, for people.
        check: Which property must hold, see ``PROPERTIES``.
        needs: "pixels": a Gaussian for each pixel; "photos": those and photos; "file": a scene with cameras in a file.
        change: Gives the changed scene; None: the scene stays, the run differs.
        threads: To run with; None: as told.
        convention: How poses are to be written, in the words of camera files.
    """

    name: str
    words: str
    check: Check
    needs: Needs = "anything"
    change: Callable[[Judged], Judged] | None = None
    threads: int | None = None
    convention: tuple[str, str] | None = None


def _rewritten(direction: str, axes: str) -> Case:
    """Poses in another convention; "camera-to-world" and "OpenCV" make "c2w-opencv"."""
    name = direction[0] + "2" + direction.split("-")[2][0] + "-" + axes.lower()
    return Case(name, f"poses written {direction}, {axes} axes", "convention", "file", convention=(direction, axes))


CASES: dict[str, Case] = {
    case.name: case
    for case in (
        Case("unchanged", "the scene as it is", "better"),
        Case("views-half", "half of the views", "better", "pixels", changes.half_the_views),
        Case("views-3", "three views", "better", "pixels", partial(changes.fewer_views, count=3)),
        Case("views-1", "one view", "better", "pixels", partial(changes.fewer_views, count=1)),
        Case("order", "views in another order", "same", "pixels", changes.reordered),
        Case("twice", "every view twice", "once", "pixels", changes.repeated),
        Case("poses-0.2", "poses 0.2 degrees off", "better", "photos", partial(changes.wrong_poses, degrees=0.2)),
        Case("poses-1", "poses 1 degree off", "better", "photos", partial(changes.wrong_poses, degrees=1.0)),
        Case("poses-5", "poses 5 degrees off", "better", "photos", partial(changes.wrong_poses, degrees=5.0)),
        Case("exposure", "exposure +-20 % by turns", "better", "photos", partial(changes.other_exposure, share=0.2)),
        Case("utm", "moved to map coordinates", "same", "anything", partial(changes.moved, factor=1.0, shift=UTM)),
        Case("small", "scaled by 1e-4", "same", "anything", partial(changes.moved, factor=1e-4, shift=(0, 0, 0))),
        Case("large", "scaled by 1e4", "same", "anything", partial(changes.moved, factor=1e4, shift=(0, 0, 0))),
        Case("broken", "1 % of the rows not finite", "near", "anything", changes.broken_rows),
        Case("flyaways", "0.0025 % of the Gaussians far away", "near", "anything", changes.flyaways),
        Case("oversized", "1 % of the Gaussians 8 times as large", "near", "anything", changes.oversized),
        Case("threads", "one thread", "bits", threads=1),
        Case("again", "the result compacted once more", "again"),
        *(_rewritten(*convention) for convention in CONVENTIONS),
    )
}  # fmt: skip
