"""``gsmerge lab stress``: test a user's own scene under bad conditions."""

from typing import TYPE_CHECKING, Annotated

from gsmerge.cli import parameters as opt
from gsmerge.cli.before_after import held_out_views, require_views
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.errors import TargetError
from gsmerge.frozen import asdict, dataclass
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.setting import Settings, setting

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class StressFiles(Settings):
    """Files beside the scene of a stress test."""

    cameras: str | None = setting(None, "Its cameras; by default those beside it.")
    images: str | None = setting(None, "Folder of its photos; by default beside it.")
    targets: str | None = setting(None, "Cameras of held-out photos.")
    target_images: str | None = setting(None, "Folder of the held-out photos; by default beside their cameras.")


SETTINGS = (CompactOptions, StressFiles)


def stress(
    scene: opt.Scene,
    cases: Annotated[str | None, opt.option(opt.MEASURING, "NAME,...", "Try only these.", default="all")] = None,
    set: Annotated[list[str] | None, opt.settings_option(SETTINGS, example="targets=FILE")] = None,
    json: opt.Json = False, progress: opt.Progress = None, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Compact a scene under bad conditions, and report for each condition if the required property holds."""
    from gsmerge.reading.read_scene import read_files
    from gsmerge.reading.scene_files import find_scene_files
    from gsmerge.research.stress import stress as stress_scene
    from gsmerge.runtime.documents import document_head, note_entries

    settings, places = opt.read_settings(SETTINGS, set).make(*SETTINGS)
    cameras = opt.path_or_none(places.cameras)
    images = opt.path_or_none(places.images)
    load = read_files(find_scene_files(scene, cameras=cameras, images=images))
    require_views(load)
    targets, target_images = map(opt.read_path, (places.targets, places.target_images))
    _, held_out, adapted = held_out_views(load, targets, target_images, None)
    notes = [*load.notes, *adapted]
    say_notes(notes, quiet=quiet or json)
    names = None if cases is None else [name.strip() for name in cases.split(",")]
    with stage_progress(quiet=quiet or json) as on_step:
        outcomes = stress_scene(load.scene, settings, targets=held_out, cases=names, progress=on_step)
    document = {
        **document_head(),
        "input": str(load.files.ply),
        "options": settings.to_dict(),
        "cases": [asdict(outcome) for outcome in outcomes],
        "held": sum(outcome.held is True for outcome in outcomes),
        "failed": sum(outcome.held is False for outcome in outcomes),
        **note_entries(notes),
    }
    # A line for each case, the properties that failed, and the number that held
    marks = {True: "held", False: "FAILED", None: "-"}
    width = max((len(outcome.words) for outcome in outcomes), default=0)
    lines = [f"{marks[o.held]:<7} {o.words:<{width}}  {o.found}" for o in outcomes]
    lines += [f"        expected of '{o.words}': {o.wanted}" for o in outcomes if o.held is False]
    num_tried = sum(outcome.held is not None for outcome in outcomes)
    lines += [f"{document['held']} of {num_tried} held"]
    print_document(document, lines, as_json=json, quiet=quiet)
    failed = [outcome.case for outcome in outcomes if outcome.held is False]
    if failed:
        raise TargetError(f"{len(failed)} of {len(outcomes)} cases failed: {', '.join(failed)}")
