"""Scenes are found in any layout."""

from __future__ import annotations

import os
import pathlib
import sys
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
from batches import touch
from messages import refuses

from gsmerge.errors import SceneError, UsageError
from gsmerge.jobs.batch.find import describe_lost, find_named_scenes, find_scenes
from gsmerge.reading.scene_files import find_scene_files

OUT = Path("out")
pytestmark = pytest.mark.usefixtures("inside")


def find_paths(*given: str, out: Path = OUT) -> list[str]:
    return [scene.as_posix() for scene in find_scenes(given, out)]


FOLDERS: dict[str, tuple[list[str], list[str]]] = {  # files in a folder, and the scenes that are found in it
    "scenes at every depth": (
        ["b/scene.ply", "b/other.ply", "a/x.ply", "a/y.ply", "deep/er/gs_ply/0000.ply", "inria/input.ply", "z.ply",
         "inria/point_cloud/iteration_7000/point_cloud.ply"],
        ["all/z.ply", "all/a/x.ply", "all/a/y.ply", "all/b", "all/deep/er", "all/inria"],
    ),
    "results, hidden files and point clouds": (
        ["a.ply", "a.compact.ply", "a.compact.level1.ply", ".a-00112233.ply", ".hidden/b.ply", "points3D.ply",
         "c/scene.ply", "c/images/mask.ply", "input/d.ply"],
        ["all/a.ply", "all/c", "all/input/d.ply"],
    ),
    "a folder of Gaussians inside a scene": (["scene.ply", "gs_ply/0000.ply", "more/scene.ply"], ["all", "all/more"]),
    "a name that looks like a pattern": (["run[1]/scene.ply"], ["all/run[1]"]),
}  # fmt: skip


@pytest.mark.parametrize("case", FOLDERS)
def test_scenes_alone_are_found_in_a_folder(case: str) -> None:
    files, scenes = FOLDERS[case]
    touch(*(f"all/{file}" for file in files))
    assert find_paths("all") == scenes
    assert find_paths(scenes[-1]) == scenes[-1:]


def test_a_point_cloud_with_the_name_of_a_scene_is_a_scene_that_fails() -> None:
    """Unless its folder has other Gaussians; a point cloud with another name is none."""
    points = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
    touch("all/a/scene.ply", "all/b/scene.ply", "all/b/c/deep.ply", "all/d/cloud.ply", "all/e/point_cloud.ply")
    for name in ("a/scene.ply", "b/scene.ply", "d/cloud.ply", "e/point_cloud.ply"):
        Path("all", name).write_text(points)
    assert find_paths("all") == ["all/a", "all/b/c/deep.ply", "all/e"]
    assert find_paths("all/a") == ["all/a"]
    with refuses(SceneError, "all/d", "cloud.ply"):
        find_paths("all/d")


def test_an_archive_with_gaussians_is_a_scene_that_fails() -> None:
    """Unless it was unpacked beside it; an archive of photos is none."""
    touch("all/a.ply", "all/done/scene.ply")
    for name, member in (("new", "x/scene.ply"), ("done", "scene.ply"), ("photos", "1.jpg")):
        with ZipFile(f"all/{name}.zip", "w") as archive:
            archive.writestr(member, b"0")
    Path("all/broken.zip").write_bytes(b"PK")
    assert find_paths("all") == ["all/a.ply", "all/new.zip", "all/done"]
    with refuses(SceneError, "all/new.zip", "zip archive", "unpack"):
        find_scene_files("all/new.zip")


def test_the_output_folder_is_not_searched() -> None:
    touch("all/a.ply", "all/out/a.ply", "all/out/deep/b.ply")
    assert find_paths("all", out=Path("all/out")) == ["all/a.ply"]
    assert find_paths("all/*", out=Path("all/out")) == ["all/a.ply"]
    with refuses(UsageError, "all", "results"):
        find_paths("all", out=Path("all"))


def test_scenes_are_sorted_by_the_numbers_in_their_names() -> None:
    """So that {index} is that of the moment."""
    touch(*(f"all/frame_{i}.ply" for i in range(1, 13)), *(f"all/room{i}/scene.ply" for i in (10, 9, 100)))
    frames, rooms = [f"all/frame_{i}.ply" for i in range(1, 13)], [f"all/room{i}" for i in (9, 10, 100)]
    assert find_paths("all") == [*frames, *rooms]
    assert find_paths("all/*.ply") == frames
    assert find_paths("all/r*") == rooms
    touch("zeros/view_01.ply", "zeros/view_1.ply", "zeros/view_001.ply")
    assert find_paths("zeros") == ["zeros/view_001.ply", "zeros/view_01.ply", "zeros/view_1.ply"]


def test_patterns_and_lists_give_the_scenes_that_they_name() -> None:
    touch("s/one/scene.ply", "s/two/scene.ply", "s/notes.ply.txt", "s/x.ply")
    assert find_paths("s/*") == ["s/one", "s/two", "s/x.ply"]
    assert find_paths("s/**/scene.ply") == ["s/one/scene.ply", "s/two/scene.ply"]
    Path("s/list.txt").write_text("# mine\none\n\n  x.ply  \ngone.ply\n")
    assert find_paths("s/list.txt") == ["s/one", "s/x.ply", "s/gone.ply"]  # what is gone fails when its turn comes


def link(path: str, target: str) -> None:
    Path(path).symlink_to(target, target_is_directory=True)


def test_folders_are_entered_once_whatever_links_lead_to_them() -> None:
    folder = "all"
    for _ in range(16):  # 65,536 paths
        Path(folder).mkdir()
        link(f"{folder}/b", "a")
        folder += "/a"
    touch(f"{folder}/x.ply")
    assert find_paths("all") == [f"{folder}/x.ply"]
    assert find_paths("all/**/*.ply") == [f"{folder}/x.ply"]


@pytest.mark.parametrize("given", ["all", "all/*", "all/list.txt"])
def test_a_scene_is_found_under_the_name_of_its_folder_before_links(given: str) -> None:
    """The folder is entered under its own name, whichever comes first."""
    touch("all/room/scene.ply", "all/z/deep/hall/scene.ply")
    link("all/latest", "room")
    link("all/a", "z/deep")
    Path("all/list.txt").write_text("latest\na\nroom\nz\n")
    assert find_paths(given) == ["all/room", "all/z/deep/hall"]


@pytest.mark.parametrize(
    ("files", "is_lost"),
    [
        (["x/images/1.png"], True), (["x/transforms.json"], True), (["x/SCENE.PLY"], True),
        (["x/scene.ply.part"], True), (["x/sparse/0/cameras.bin", "x/images/1.png"], True),
        ([], False), (["x/notes.txt"], False), (["x/1.png"], False), (["x/a.compact.ply"], False),
        (["images/a/images/1.png"], False), (["colmap/sparse/0/cameras.bin"], False), (["out/images/1.png"], False),
        (["x/images/1.png", "x/deep/scene.ply"], False), (["x/images/1.png", "x/y.ply"], False),
        (["bare/data/images/1.png", "bare/output/point_cloud.ply"], False), (["a/data/images/1.png"], False),
    ],
)  # fmt: skip
def test_folders_that_look_like_scenes_without_gaussians_are_noted(files: list[str], is_lost: bool) -> None:
    touch("all/a/scene.ply", "all/a/images/1.png", "all/b/scene.ply", *(f"all/{file}" for file in files))
    looks: list[str] = []
    scenes = {str(scene) for scene, _ in find_named_scenes(["all"], Path("all/out"), looks)}
    found = describe_lost(looks, scenes)
    assert [str(Path("all/x")) in note for note in found] == [True] * is_lost


def test_a_pattern_enters_folders_of_every_depth() -> None:
    touch("s/scene.ply", "s/gs_ply/0000.ply", "s/a/b/c.ply", "s/a/b/.hidden/d.ply", "s/out/e.ply")
    assert find_paths("s/**/*.ply", out=Path("s/out")) == ["s/a/b/c.ply", "s/gs_ply/0000.ply", "s/scene.ply"]
    assert find_paths("s/**/b/*", "**/c.ply", out=Path("s/out")) == ["s/a/b/c.ply", "s/a/b/c.ply"]
    assert find_paths("s/a/**") == ["s/a/b/c.ply"]


@pytest.mark.skipif(os.name == "nt", reason="links as POSIX has them")
def test_a_folder_of_too_many_others_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.jobs.batch.find.MAX_FOLDERS", 3)
    touch("system/1/2/3/4.txt", "all/a.ply", *(f"many/{i}/scene.ply" for i in range(9)))
    assert len(find_paths("many")) == 9
    link("all/link", "../system")
    with refuses(SceneError, "all/link/1/2/3", 3):
        find_paths("all")


def test_a_scene_that_a_list_names_again_is_found_once() -> None:
    touch("s/a/scene.ply", "s/b.ply")
    Path("list").write_text("s/a\ns/b.ply\n" * 100_000 + "./s/a\ns\n")
    assert find_paths("list") == ["s/a", "s/b.ply", "s/b.ply"]


def test_a_list_of_more_scenes_than_its_bytes_allow_is_refused() -> None:
    Path("list").write_text("\n".join(f"{i:x}" for i in range(200_000)))
    with refuses(SceneError, "list", f"{Path('list').stat().st_size:,} bytes"):
        find_paths("list")


@pytest.fixture
def locked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let folders named locked refuse to be read; permissions mean nothing to root, which tests may run as."""
    scandir = os.scandir

    def refuse(path: str | Path) -> object:
        if Path(path).name == "locked":
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)
    if hasattr(pathlib, "_NormalAccessor"):  # of Python 3.10, which has its own name for it
        monkeypatch.setattr(pathlib._NormalAccessor, "scandir", staticmethod(refuse))


@pytest.mark.usefixtures("locked")
def test_a_folder_that_cannot_be_read_is_a_scene_that_fails() -> None:
    touch("all/a.ply", "all/locked/b.ply", "all/z/c.ply")
    assert find_paths("all") == ["all/a.ply", "all/locked", "all/z/c.ply"]
    for given in ("all/locked", "all/lock*"):
        assert find_paths(given) == ["all/locked"]
    if sys.version_info < (3, 13):  # whose pathlib calls what the fixture put in the place of os.scandir
        with refuses(SceneError, "all/locked", "Permission denied"):
            find_scene_files(Path("all/locked"))


@pytest.mark.parametrize("is_listed", [False, True])
def test_a_folder_that_vanishes_is_a_scene_that_fails(is_listed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before its names are listed, and after."""
    touch("all/a.ply", "all/gone/b.ply", "all/z/c.ply")
    scandir = os.scandir

    def vanish(path: Any = ".") -> Any:
        listed = scandir(path) if is_listed else None
        if str(path) == os.path.join("all", "gone") and os.path.isdir(path):
            os.rename(path, "elsewhere")
        return listed or scandir(path)

    monkeypatch.setattr(os, "scandir", vanish)
    assert find_paths("all") == ["all/a.ply", "all/gone", "all/z/c.ply"]
    with refuses(SceneError, "all/gone", "no such file"):
        find_scene_files(Path("all/gone"))


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("gone.ply", "file"), ("gone", "file or folder"), ("gone/*", "match"), ("empty", "folder"),
        ("blank.txt", "list"), ("binary.bin", "text"),
    ],
)  # fmt: skip
def test_places_without_a_scene_are_refused(given: str, found: str) -> None:
    Path("empty").mkdir()
    Path("blank.txt").write_text("\n# nothing\n")
    Path("binary.bin").write_bytes(b"a\0b")
    with refuses(SceneError, given, found):
        find_paths(given)
