"""The page's pictures: results over photos with a slider between, and error maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsmerge.research.charts.experiment import OURS
from gsmerge.research.charts.markup import data_uri, text
from gsmerge.research.charts.measure import WORST
from gsmerge.research.charts.record import INPUT, RunRecord
from gsmerge.research.charts.series import line_key, line_names, stands_for_all, usual_size, usual_views
from gsmerge.research.charts.store import picture_path

MOST_SCENES = 6  # whose pictures are on the page
MOST_RESULTS = 5  # beside the photo and the input


@dataclass(frozen=True)
class Shot:
    """One view of one scene: what there is to compare.

    Args:
        scene: Its name.
        view: Its name.
        layers: Name and file of each picture: photo, input, ours, rivals.
        errors: The same of the error maps.
    """

    scene: str
    view: str
    layers: tuple[tuple[str, Path], ...]
    errors: tuple[tuple[str, Path], ...]


def find_shots(records: Sequence[RunRecord], folder: Path) -> list[Shot]:
    """Views with pictures of the input and of results of the usual size, scene by scene, ours first."""
    size, views = usual_size(records), usual_views(records)
    names = line_names(list(dict.fromkeys(line_key(r) for r in records if r.method != INPUT)))
    shots: list[Shot] = []
    for scene in list(dict.fromkeys(record.scene for record in records))[:MOST_SCENES]:
        own = [r for r in records if r.scene == scene and r.views_asked == views and r.pictures]
        inputs = [r for r in own if r.method == INPUT][-1:]
        results = [r for r in own if stands_for_all(r, size)]
        results.sort(key=lambda r: (r.method != OURS, len(line_key(r)[1])))
        chosen = [*inputs, *results[:MOST_RESULTS]]
        for i, view in enumerate(chosen[0].pictures if chosen else ()):
            photo = picture_path(folder, chosen[0].scene_sha256, i, "photo")
            layers = [("photo", photo)] if photo.exists() else []
            errors: list[tuple[str, Path]] = []
            for record in chosen:
                name = INPUT if record.method == INPUT else names[line_key(record)]
                for kind, found in (("render", layers), ("error", errors)):
                    path = picture_path(folder, record.key, i, kind)
                    if path.exists():
                        found.append((name, path))
            if len(layers) > 1:
                shots.append(Shot(scene, view, tuple(layers), tuple(errors)))
    return shots


def compare_section(records: Sequence[RunRecord], folder: Path) -> str:
    """Sliders between photo, input and results; the arrow keys move them."""
    shots = find_shots(records, folder)
    if not shots:
        return ""
    how = "Left and right of the line; drag it, or move the slider with the arrow keys."
    sliders = "".join(_slider(shot, number) for number, shot in enumerate(shots))
    return f'<p class="muted">{how}</p><div class="pairs">{sliders}</div>'


def _slider(shot: Shot, number: int) -> str:
    names = [name for name, _ in shot.layers]
    left = names.index(INPUT) if INPUT in names else 0
    right = next((i for i, name in enumerate(names) if name.startswith(OURS)), len(names) - 1)
    images = "".join(
        f'<img class="layer{" left" * (i == left)}{" right" * (i == right)}" src="{data_uri(path)}"'
        f' alt="{text(f"{shot.scene}, {shot.view}: {name}")}">'
        for i, (name, path) in enumerate(shot.layers)
    )
    sides = "".join(
        f"<label>{side} <select>"
        + "".join(f'<option value="{i}"{" selected" * (i == at)}>{text(name)}</option>' for i, name in enumerate(names))
        + "</select></label>"
        for side, at in (("left", left), ("right", right))
    )
    title = f"{shot.scene}, {shot.view}"
    spoken = text(f"how much of the left picture: {title}")
    return (
        f'<div class="compare" id="compare-{number}"><h3>{text(title)}</h3>'
        f'<div class="frame">{images}</div>'
        f'<input type="range" min="0" max="100" value="50" aria-label="{spoken}">'
        f'<div class="sides">{sides}</div></div>'
    )


def error_section(records: Sequence[RunRecord], folder: Path) -> str:
    """Error maps side by side, with their scale."""
    shots = [shot for shot in find_shots(records, folder) if shot.errors]
    if not shots:
        return ""
    parts = [
        "<p>Mean absolute error over the colour channels, the same scale for all.</p>"
        '<div class="scale"></div>'
        f'<div class="scale-words"><span>0</span><span>{WORST:g} and more</span></div>'
    ]
    for shot in shots:
        maps = "".join(
            f'<figure><img src="{data_uri(path)}" alt="{text(f"error of {name}")}">'
            f"<figcaption>{text(name)}</figcaption></figure>"
            for name, path in shot.errors
        )
        parts.append(f'<h3>{text(f"{shot.scene}, {shot.view}")}</h3><div class="maps">{maps}</div>')
    return "".join(parts)
