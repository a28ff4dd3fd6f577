"""Show scenes and results in notebooks and browsers: the page of ``gsmerge view`` for data in memory."""

from __future__ import annotations

import html
import webbrowser
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from gsmerge.drawing.pages.data import collect_page_data
from gsmerge.drawing.pages.page import headline, view_page
from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass, replace
from gsmerge.io.atomic import atomic_output
from gsmerge.io.first_bytes import may_be_replaced
from gsmerge.io.formats.ply import file_bytes
from gsmerge.io.formats.read_gaussians import GaussianFile, read_gaussians
from gsmerge.io.formats.rows import ExpectedScores, read_expected_scores
from gsmerge.method.viewpoints.place_cameras import add_views
from gsmerge.reading.input import as_scene
from gsmerge.reading.scene_files import find_scene_files, scene_title
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.memory import human_bytes
from gsmerge.runtime.record import Progress, record_run
from gsmerge.types import Gaussians, HasGaussians, Scene, StrPath, Views, own_gaussians

NOTEBOOK_HEIGHT = 820  # height of a page in a notebook, pixels


@dataclass(frozen=True, repr=False)
class Page:
    """A page in one file, which notebooks can show."""

    text: str  # HTML
    headline: str  # share of the Gaussians and change of quality, in words

    def __repr__(self) -> str:
        return f"Page({self.headline}, {human_bytes(len(self.text))})"

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {NOTEBOOK_HEIGHT}px; border: 0"
        return f'<iframe srcdoc="{html.escape(self.text)}" style="{style}" allowfullscreen></iframe>'

    @check_arguments
    def save(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write the page as an ``.html`` file that opens anywhere, and return its path.

        An existing file is replaced if it is a page that gsmerge made, or if ``overwrite``. Raises UsageError if the
        name does not end in .html.
        """
        check_page_name(Path(path))
        with atomic_output(path, overwrite=overwrite or may_be_replaced(Path(path))) as temporary:
            temporary.write_bytes(self.text.encode())
        return Path(path)

    def open(self) -> None:
        """Open the page in the browser, from a temporary file."""
        webbrowser.open(self.save(Path(mkdtemp(prefix="gsmerge-")) / "view.html").as_uri())


def check_page_name(path: Path) -> None:
    """Raise UsageError unless the name of a page ends in .html."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{path}: expected a name ending in .html")


@check_arguments
def view(
    scene: Scene | HasGaussians | Gaussians | StrPath,
    results: Mapping[str, HasGaussians | Gaussians | StrPath] | HasGaussians | Gaussians | StrPath | None = None,
    held_out: Views | None = None,
    *,
    light: bool | None = None,
    progress: Progress | None = None,
) -> Page:
    """Show a scene, alone or beside results: photos, a swipe, 3D and scores, as ``gsmerge view`` does.

    Args:
        scene: A scene from :func:`gsmerge.read_scene`, or the path that it reads. A result alone is shown beside its
            scene.
        results: Results of the scene by name, or one result. A result comes from :func:`gsmerge.compact`, or is
            Gaussians, or the path of a file.
        held_out: Views with photos that were not part of the input, for scores.
        light: If True, the scene itself is shown in stills only. None: True if the scene has more than 600,000
            Gaussians.
        progress: Called with (name of the step, number done, total).

    Returns:
        A page, which a notebook shows if it is the last value of a cell. ``save(path)`` writes it as one ``.html``
        file, ``open()`` opens it in the browser.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=300)
        >>> page = gsmerge.view("demo", {"small": result})
        >>> page.save("demo/small.html", overwrite=True).name
        'small.html'
    """
    given: Any = scene
    if results is None and hasattr(given, "show"):
        page: Page = given.show()
        return page
    with record_run(progress):
        input_scene = as_scene(given).numpy()
        shown_scene = add_views(input_scene, shown=True)  # viewpoints are placed for a scene without views
    named = results if isinstance(results, Mapping) else {"result": results}
    if results is None:
        named = {}
    files = {name: read_gaussians(path) for name, path in named.items() if isinstance(path, str | PathLike)}
    loaded: dict[str, Any] = {**named, **files}
    gaussians = {name: own_gaussians(result) for name, result in loaded.items()}
    new_views = file_new_views(files) | {
        name: expected
        for name, result in named.items()
        if (expected := getattr(getattr(result, "report", None), "new_views", None)) is not None
    }
    cameras = {
        name: replace(shown_scene.cameras, antialiased=file.info.antialiased) for name, file in files.items()
    } | {
        name: replace(shown_scene.cameras, viewmats=moved.numpy().viewmats)
        for name, result in named.items()
        if (moved := getattr(result, "cameras", None)) is not None
        and len(moved) == len(shown_scene) == len(input_scene)
    }
    reports = [getattr(result, "report", None) for result in named.values()]
    changes = list(dict.fromkeys(text for report in reports if report for text in report.choices.get("changes", ())))
    max_solid = 600_000  # most Gaussians of a scene that is shown in 3D, 8 MB of a notebook
    is_light = len(input_scene.gaussians) > max_solid if light is None else light
    data = collect_page_data(
        scene_title(Path(scene)) if isinstance(scene, str | PathLike) else "scene", shown_scene, gaussians,
        [_num_bytes(scene), *(_num_bytes(result) for result in loaded.values())], held_out,
        cameras=cameras, new_views=new_views, changes=changes, light=is_light, progress=progress or (lambda *_: None),
    )  # fmt: skip
    return Page(view_page(data).decode(), headline(data))


def file_new_views(files: Mapping[str, GaussianFile]) -> dict[str, ExpectedScores]:
    """Return the expected scores of new views, by the name of each result whose file states them."""
    known = {name: read_expected_scores(file.info.comments) for name, file in files.items()}
    return {name: scores for name, scores in known.items() if scores}


def _num_bytes(value: Any) -> int:
    """Return the size in bytes of a scene's files, or of a file that was read.

    For Gaussians that come from no file, it is the size that a ``.ply`` would have.
    """
    if isinstance(value, GaussianFile):
        return value.info.file_bytes
    if isinstance(value, str | PathLike):
        return sum(path.stat().st_size for path in find_scene_files(value).plys)
    gaussians = own_gaussians(value)
    return file_bytes(len(gaussians), gaussians.sh_degree)
