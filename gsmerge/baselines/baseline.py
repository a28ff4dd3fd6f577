"""What a baseline (another method) is: a name, what it needs, which settings it uses, and a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from gsmerge.build import Source
from gsmerge.options import CompactOptions
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.decode import DecodeOptions, decode
from gsmerge.stages.encode import EncodeOptions, encode
from gsmerge.stages.group import Canvas
from gsmerge.stages.unaligned import members_of
from gsmerge.types import Gaussians, Groups, PixelScene

Need = Literal["photos", "pixels", "node"]
Run = Callable[[Source, Canvas, CompactOptions, int, RunLog], Gaussians]

COUNTS = ("budget", "max_bytes", "preset", "superpixels", "density", "k")  # settings that decide how many


@dataclass(frozen=True)
class Baseline:
    """One other method.

    Args:
        name: As on the command line.
        title: What it does, in a few words.
        run: Source, canvas, options, number of Gaussians, run log -> canonical Gaussians, at most that many unless
            the method keeps the input's. It times itself, by stages of the run log.
        needs: ``"photos"``; ``"pixels"``: one Gaussian per pixel; ``"node"``: a program that runs in Node.js.
        uses: Settings that it uses, by flat name, besides those that all methods use.
    """

    name: str
    title: str
    run: Run
    needs: tuple[Need, ...] = ()
    uses: tuple[str, ...] = COUNTS


def own_gaussians(source: Source) -> Gaussians:
    """The Gaussians that the file has, without the rows that only stand in for missing or broken ones."""
    scene = source.scene
    if isinstance(scene, PixelScene) and not bool(scene.stored.all()):
        return scene.gaussians[scene.stored.reshape(-1)]
    return scene.gaussians


def view_shares(count: int, num_views: int, max_per_view: int) -> list[int]:
    """A number divided evenly among the views, at most ``max_per_view`` each; the first views get the rest."""
    return [min(max_per_view, count // num_views + (view < count % num_views)) for view in range(num_views)]


def merge_groups(
    source: Source, groups: Groups, options: CompactOptions, log: RunLog, rule: Literal["depth", "paper"] = "depth"
) -> Gaussians:
    """One Gaussian for each group, without matching across views; groups that hold nothing are left out."""
    with log.stage("encode"):
        members = members_of(source.scene, groups, options) if source.members is None else source.members
        features = encode(source.scene, members, groups, EncodeOptions(rule=rule))
    with log.stage("decode"):
        return decode(features, members, DecodeOptions(min_opacity=0.0), rule=rule)
