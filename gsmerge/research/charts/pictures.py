"""The page's pictures: results and photos with a slider between them, and error maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsmerge.research.charts.experiment import OURS
from gsmerge.research.charts.markup import data_uri, text
from gsmerge.research.charts.measure import MAX_ERROR
from gsmerge.research.charts.record import INPUT, RunRecord, picture_path
from gsmerge.research.charts.series import is_typical, line_key, names_of, ours_first, typical_size, typical_views

MAX_SCENES = 6  # with pictures on the page
MAX_RESULTS = 5  # pictures of a view in addition to the photo and the input


@dataclass(frozen=True)
class PictureSet:
    """The pictures of one view of one scene."""

    scene: str  # its name
    view: str  # its name
    layers: tuple[tuple[str, Path], ...]  # name and file of each picture: photo, input, ours, baselines
    errors: tuple[tuple[str, Path], ...]  # the same of the error maps


def find_pictures(records: Sequence[RunRecord], folder: Path) -> list[PictureSet]:
    """Views with pictures of the input and of results of the typical size, scene by scene, ours first."""
    size, views = typical_size(records), typical_views(records)
    names, sets = names_of(records), list[PictureSet]()
    for scene in list(dict.fromkeys(record.scene for record in records))[:MAX_SCENES]:
        own = [r for r in records if r.scene == scene and r.views_asked == views and r.pictures]
        inputs = [r for r in own if r.method == INPUT][-1:]
        chosen = [*inputs, *ours_first(r for r in own if is_typical(r, size))[:MAX_RESULTS]]
        for i, view in enumerate(chosen[0].pictures if chosen else ()):
            photo = picture_path(folder, chosen[0].scene_sha256, i, "photo")
            layers = [("photo", photo)] if photo.exists() else []
            errors: list[tuple[str, Path]] = []
            for record in chosen:
                for kind, pictures in (("render", layers), ("error", errors)):
                    path = picture_path(folder, record.key, i, kind)
                    if path.exists():
                        pictures.append((names[line_key(record)], path))
            if len(layers) > 1:
                sets.append(PictureSet(scene, view, tuple(layers), tuple(errors)))
    return sets


def slider_section(sets: Sequence[PictureSet]) -> str:
    """Sliders between photo, input and results; the arrow keys move them."""
    how = "Left and right of the line; drag it, or move the slider with the arrow keys."
    sliders = "".join(_slider(one, number) for number, one in enumerate(sets))
    return f'<p class="muted">{how}</p><div class="pairs">{sliders}</div>' if sets else ""


def _slider(pictures: PictureSet, number: int) -> str:
    names = [name for name, _ in pictures.layers]
    left = names.index(INPUT) if INPUT in names else 0
    right = next((i for i, name in enumerate(names) if name.startswith(OURS)), len(names) - 1)
    images = "".join(
        f'<img class="layer{" left" * (i == left)}{" right" * (i == right)}" src="{data_uri(path)}"'
        f' alt="{text(f"{pictures.scene}, {pictures.view}: {name}")}">'
        for i, (name, path) in enumerate(pictures.layers)
    )
    sides = "".join(
        f"<label>{side} <select>"
        + "".join(f'<option value="{i}"{" selected" * (i == at)}>{text(name)}</option>' for i, name in enumerate(names))
        + "</select></label>"
        for side, at in (("left", left), ("right", right))
    )
    title = f"{pictures.scene}, {pictures.view}"
    aria_label = text(f"how much of the left picture: {title}")
    return (
        f'<div class="compare" id="compare-{number}"><h3>{text(title)}</h3>'
        f'<div class="frame">{images}</div>'
        f'<input type="range" min="0" max="100" value="50" aria-label="{aria_label}">'
        f'<div class="sides">{sides}</div></div>'
    )


def error_section(sets: Sequence[PictureSet]) -> str:
    """Error maps side by side, with their scale."""
    if not any(one.errors for one in sets):
        return ""
    parts = [
        "<p>Mean absolute error over the colour channels, the same scale for all.</p>"
        '<div class="scale"></div>'
        f'<div class="scale-words"><span>0</span><span>{MAX_ERROR:g} and more</span></div>'
    ]
    for one in (one for one in sets if one.errors):
        maps = "".join(
            f'<figure><img src="{data_uri(path)}" alt="{text(f"error of {name}")}">'
            f"<figcaption>{text(name)}</figcaption></figure>"
            for name, path in one.errors
        )
        parts.append(f'<h3>{text(f"{one.scene}, {one.view}")}</h3><div class="maps">{maps}</div>')
    return "".join(parts)
