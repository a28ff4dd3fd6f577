"""The command line and Python make the same results, and read an input once."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from messages import names
from shared import write_smallest

import gsmerge
import gsmerge.reading.input as stage
from gsmerge.errors import SceneError
from gsmerge.method.geometry.views import subset
from gsmerge.reading.scene_files import find_scene_files
from gsmerge.results.outputs import Outputs
from gsmerge.run import compact_files
from gsmerge.runtime.documents import file_sha256
from gsmerge.settings.compact import CompactOptions

from .conftest import Run


@pytest.fixture(scope="module")
def one_photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scene of one view, whose number of Gaussians goes by other rules. Read only."""
    folder = write_smallest(tmp_path_factory.mktemp("one") / "scene")
    alone = subset(gsmerge.read_scene(folder), [0]).gaussians
    gsmerge.write_ply(folder / "scene.ply", alone, overwrite=True)
    cameras = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps(cameras | {"frames": cameras["frames"][:1]}))
    return folder


@pytest.mark.parametrize("scene", ["smallest_scene", "one_photo"])
@pytest.mark.parametrize("settings", [{}, {"budget": "auto"}, {"budget": "mobile"}, {"levels": 2}, {"k": 2}])
def test_a_file_holds_what_python_returns(
    scene: str, settings: dict[str, str], tmp_path: Path, run: Run, request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(scene)
    words = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    run("compact", folder, "--effort", "draft", "-o", tmp_path / "a.ply", *words, code=0)
    result = gsmerge.compact(folder, effort="draft", **settings)
    written = gsmerge.read_ply(tmp_path / "a.ply").gaussians
    assert np.array_equal(written.means, result.gaussians.means.astype(np.float32))
    if scene == "one_photo":  # a draft of one photo has four for each superpixel, unless their number is asked for
        assert result.report.options["k"] == settings.get("k", 4 if "budget" not in settings else 1)


PLAIN = CompactOptions().with_settings({"superpixels": "20%", "fit": "none", "threads": 1})
FAST = ("--effort", "draft", "--set", "fit=none", "--set", "superpixels=20%")


def replace(folder: Path) -> None:
    (folder / "new.ply").write_bytes((folder / "scene.ply").read_bytes()[:-4] + b"abcd")
    os.replace(folder / "new.ply", folder / "scene.ply")


@pytest.mark.parametrize(
    ("act", "is_doubt"),
    [(lambda folder: folder.rename(folder.with_name("moved")), False), (replace, True)],
    ids=["moved", "replaced"],
)
def test_moved_or_replaced_scene_is_not_read_again(
    act: Callable[[Path], None], is_doubt: bool, smallest_copy: Path
) -> None:
    sha256, out = file_sha256(smallest_copy / "scene.ply"), smallest_copy.parent / "o.ply"
    files, num_bytes = find_scene_files(smallest_copy), (smallest_copy / "scene.ply").stat().st_size
    document = compact_files(files, PLAIN, Outputs(out), hashed=True, on_read=lambda _: act(smallest_copy))
    assert out.is_file()
    assert (document["input"]["sha256"], document["input"]["bytes"]) == (sha256, num_bytes)
    assert [names(doubt, "scene.ply changed during the run") for doubt in document["doubts"]] == [True] * is_doubt
    assert set(document["doubts"]) <= set(document["notes"])


def test_a_file_that_changes_while_it_is_read_is_refused(smallest_copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = stage.read_files

    def read_and_replace(*arguments: Any, **options: Any) -> Any:
        loaded = read(*arguments, **options)
        replace(smallest_copy)
        return loaded

    monkeypatch.setattr(stage, "read_files", read_and_replace)
    out = smallest_copy.parent / "o.ply"
    with pytest.raises(SceneError, match=r"scene\.ply: changed while it was read; run this again"):
        compact_files(find_scene_files(smallest_copy), PLAIN, Outputs(out))
    assert not out.exists()


@pytest.mark.slow
def test_file_that_broke_off_is_a_doubt_of_every_command(smallest_copy: Path, run: Run) -> None:
    """The last 60 % of it are zeros."""
    ply, out = smallest_copy / "scene.ply", smallest_copy.parent / "out"
    content = np.frombuffer(ply.read_bytes(), np.uint8).copy()
    content[len(content) * 2 // 5 :] = 0
    ply.write_bytes(content.tobytes())
    doubts = json.loads(run("inspect", smallest_copy, "--json", code=0).out)["doubts"]
    assert names(doubts[0], "rows are no Gaussians", "interrupted")
    outcome = run("compact", smallest_copy, "-o", out.with_suffix(".ply"), *FAST, "--strict", code=4)
    assert "; ".join(doubts) in outcome.err
    for options, code in ((), 0), (("--strict",), 4):  # done, then skipped
        outcome = run("batch", smallest_copy, "-o", out, *FAST, *options, code=code)
        assert [outcome.out.count(doubt) for doubt in doubts] == [1] * len(doubts)
    (line,) = (json.loads(line) for line in run("batch", smallest_copy, "-o", out, *FAST, "--json").out.splitlines())
    assert line["doubts"] == doubts
