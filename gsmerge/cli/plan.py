"""What ``--dry-run`` of compact and encode prints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gsmerge.cli.console import print_document
from gsmerge.cli.options import Args, usage_errors

if TYPE_CHECKING:
    from gsmerge.io import ReadHints, SceneFiles
    from gsmerge.options import CompactOptions


def print_plan(args: Args, files: SceneFiles, settings: CompactOptions, out: Path, hints: ReadHints) -> None:
    """Print what would be done, as lines or JSON."""
    from gsmerge.baselines import choose_baseline
    from gsmerge.compact_file import read_input
    from gsmerge.options import to_schema
    from gsmerge.report import document_head
    from gsmerge.runtime.estimate import plan_document, plan_lines
    from gsmerge.runtime.threads import available_threads
    from gsmerge.stages.group import budget_count, largest_count, superpixels_per_view

    given = read_input(files, opacity=args.opacity, hints=hints)
    scene, cameras = given.scene, given.scene.cameras
    with usage_errors():
        budget = budget_count(scene, settings)
    _, unused = choose_baseline(settings, scene)
    document = plan_document(
        {name: path and str(path) for name, path in vars(files).items()},
        (len(cameras), cameras.height, cameras.width),
        settings.resolved(photos=scene.images is not None),
        output_path=out,
        per_view=superpixels_per_view(scene, settings) if len(scene) else 0,
        photos=scene.images is not None,
        threads=settings.threads or available_threads(),
        fit_steps=settings.fit.steps,
        default_count=largest_count(scene, settings),
        budget=budget,
        notes=[*given.notes, *unused],
        count=scene.num_gaussians,
        num_rest=3 * scene.gaussians.shN.shape[1],
    )
    schema = {"options": to_schema(document["options"])}
    print_document({**document_head(), **document, **schema}, plan_lines(document), as_json=args.json)
