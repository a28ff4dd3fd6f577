"""``gsmerge inspect`` refuses what other commands refuse, by the same line: mutations of sound files of every kind.

``test_damaged_files.py`` asks the same of the table of damaged files.
"""

from __future__ import annotations

import random
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from damage import SOUNDS, places
from damage.random_changes import mutate
from forked_commands import CommandServer, Limits, refused_by_inspect

from gsmerge.jobs.file_checks import check_content

COUNT, MANY = 2, 20  # mutations of a kind
FEWER = 10  # of kinds that take one or two seconds for each mutation: their rows have to be placed
LIMITS = Limits(1 << 30, 100)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of memory and time as Linux has them")


@dataclass(frozen=True)
class Kind:
    """Sound files of a kind in a scene's folder, one of which is changed, and the command that reads them."""

    pattern: str
    sound: str = "scene"
    change: Callable[[Path], Any] = lambda _: None  # what is done to the folder first
    words: tuple[str, ...] = (
        "compact",
        "--dry-run",
        "--budget=50%",
        "{}",
    )  # the last is what is checked, {} the folder
    named: tuple[str, str] | tuple[()] = ()  # option and file: what is only found beside a scene is left out
    many: int = MANY  # mutations in the sweep


def with_one_photo(folder: Path) -> None:
    """Leave a folder with one photo: of several those that can be read are used."""
    for path in sorted((folder / "images").iterdir())[1:]:
        path.unlink()


STATE = ("compact", "--fit", "none", "-o", "made.ply", "--overwrite", "a.gsm")
KINDS = {
    "rows": Kind("scene.ply", many=FEWER),
    "parts": Kind("view_*.ply", change=places.split_in_parts(lambda path: None), many=FEWER),
    "transforms": Kind("transforms.json", named=("--cameras", "transforms.json")),
    "photos": Kind("images/*.png", change=with_one_photo, named=("--images", "images")),
    "views.npz": Kind("views.npz", "views.npz", named=("--cameras", "views.npz")),
    "results.npz": Kind("results.npz", "results.npz", named=("--cameras", "results.npz")),
    "COLMAP, binary": Kind("sparse/*s.bin", "COLMAP binary", named=("--cameras", "sparse"), many=FEWER),
    "COLMAP, text": Kind("sparse/*s.txt", "COLMAP text", named=("--cameras", "sparse"), many=FEWER),
    "state": Kind("a.gsm", "gsm", words=STATE),
    "state of two batches": Kind("a.gsm", "gsm of two batches", words=STATE),
}
OFTEN = ("views.npz", "state")  # in the default run; the others are in the sweep


def placed(words: tuple[str, ...], folder: Path) -> list[object]:
    return [folder if word == "{}" else folder / word if "." in word else word for word in words]


@pytest.mark.parametrize(
    ("name", "count"),
    [
        *((name, COUNT) for name in OFTEN),
        *(pytest.param(name, kind.many, marks=pytest.mark.slow) for name, kind in KINDS.items()),
    ],
)
def test_inspect_refuses_what_each_command_refuses(
    name: str, count: int, tmp_path: Path, server: CommandServer
) -> None:
    kind, rng = KINDS[name], random.Random(f"{name} {count}")
    folder = tmp_path / "scene"
    SOUNDS[kind.sound].put(folder)
    kind.change(folder)
    words = placed(kind.words, folder)
    check = ["inspect", words[-1]]
    if kind.named:
        option, file = kind.named
        words, check = [*words, option, folder / file], [*check, option, folder / file]
    assert server.run(words, LIMITS).code == 0
    assert server.run(check, LIMITS).code == 0
    num_refused = 0
    for _ in range(count):
        path = rng.choice(sorted(folder.glob(kind.pattern)))
        sound = path.read_bytes()
        path.write_bytes(mutate(sound, rng))
        refusal = server.run(words, LIMITS)
        assert refusal.code in (0, 3), refusal
        if refusal.code == 3:
            num_refused += 1
            refused_by_inspect(refusal, server.run(check, LIMITS))
        path.write_bytes(sound)
    assert num_refused or count == COUNT


def test_inspect_reads_a_file_with_what_is_beside_it(smallest_scene: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(smallest_scene, tmp_path / "scene"))
    whole, alone = check_content(folder), check_content(folder / "scene.ply")
    assert (whole.num_views, whole.num_photos, whole.problems, whole.notes) == (3, 3, (), ())
    assert (alone.num_views, alone.count) == (3, whole.count)
    SOUNDS["views.npz"].make(folder)
    assert not check_content(folder / "views.npz").notes
