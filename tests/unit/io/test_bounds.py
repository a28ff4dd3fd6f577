"""Limits bound what a file may ask for."""

from __future__ import annotations

import json
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from messages import refuses

from gsmerge.errors import SceneError
from gsmerge.io import bounds
from gsmerge.io.bounds import ReadBudget, check_file, check_image_size, parse_json, read_lines, read_text
from gsmerge.io.image_names import list_images
from gsmerge.jobs.content_hash import content_hash


def test_images_of_too_many_pixels_or_none_are_refused(tmp_path: Path) -> None:
    check_image_size("a", 8192, 8192)
    with refuses(SceneError, "a", "67 million", "8193 x 8192"):
        check_image_size("a", 8193, 8192)
    with refuses(SceneError, "a", "0 x 5"):
        check_image_size("a", 0, 5)


def test_pipes_and_folders_are_refused_as_files(tmp_path: Path) -> None:
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with refuses(SceneError, tmp_path / "pipe", "pipe"):
            check_file(tmp_path / "pipe")
    for path, found in ((tmp_path, "folder"), (tmp_path / "none", "no such file")):
        with refuses(SceneError, path, found):
            check_file(path)


def test_text_is_read_up_to_a_size(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbfab")
    assert check_file(tmp_path / "a") == 5
    assert read_text(tmp_path / "a") == "ab"
    assert list(read_lines(tmp_path / "a")) == ["ab"]
    with refuses(SceneError, "a", "0 MiB"):
        list(read_lines(tmp_path / "a", 4))


@pytest.mark.parametrize("read", [read_text, lambda path: list(read_lines(path))], ids=["whole", "line by line"])
def test_bytes_that_are_no_text_are_refused(read: Callable[[Path], object], tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"a\n\xff")
    with refuses(SceneError, "a", "text"):
        read(tmp_path / "a")


@pytest.mark.skipif(os.name == "nt", reason="links as POSIX has them")
def test_folders_of_too_many_photos_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a/1.png", "a/b/2.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "a" / "up").symlink_to(tmp_path)
    (tmp_path / "images").symlink_to("a")
    assert [path.name for path in list_images(tmp_path / "images")] == ["1.png", "2.png"]
    monkeypatch.setattr(bounds, "MAX_FILES", 3)
    for read in (list_images, lambda folder: content_hash([folder])):
        with refuses(SceneError, "images", 3, "--images"):
            read(tmp_path / "images")


@pytest.mark.parametrize(("size", "memory", "steps"), [(0, 64_000_000, 250_000), (10**6, 84_000_000, 350_000)])
def test_a_read_budget_grows_with_the_file(size: int, memory: int, steps: int) -> None:
    budget = ReadBudget("a", size)
    budget.check_memory(memory, "rows")
    budget.check_steps(steps, "rows")
    for needed in (memory + 1, float("nan")):
        with refuses(SceneError, "a", f"{memory // 10**6} MB", "rows"):
            budget.check_memory(needed, "rows")
    with refuses(SceneError, "a", f"{steps:,}", f"{steps + 1:,}", "rows"):
        budget.check_steps(steps + 1, "rows")


@pytest.mark.parametrize(
    "item", ["[]", "{}", "[0]", "1.5", '"ab"', '{"a":1}', '{"a":{"b":[]}}', "[[0,0],[1.5]]", '{"a":0,"b":0,"c":0}']
)
def test_json_that_would_take_too_much_memory_is_refused(item: str) -> None:
    text = f"[{','.join([item] * 20_000)}]"
    tracemalloc.start()
    json.loads(text)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    parse_json(text, ReadBudget("a", len(text)))
    allowed = ReadBudget("a", (peak - 64_000_000) // 20)  # a little less than it takes
    with refuses(SceneError, "a", "JSON"):
        parse_json(text, allowed)


def test_the_content_hash_is_of_names_and_bytes(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    (folder / "a.png").write_bytes(b"1")
    (folder / "b.png").write_bytes(b"2")
    before = content_hash([folder])
    assert before == content_hash([folder])
    (folder / "b.png").rename(folder / "c.png")
    renamed = content_hash([folder])
    (folder / "a.png").write_bytes(b"3")
    assert len({before, renamed, content_hash([folder])}) == 3


def test_the_content_hash_of_a_missing_file_is_refused(tmp_path: Path) -> None:
    with refuses(SceneError, "nothing", "No such file"):
        content_hash([tmp_path / "nothing"])
