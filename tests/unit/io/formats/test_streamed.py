"""Streamed SOG: what its specification asks for, by a checker of its own; replaced whole; damage in one line."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from messages import NO_FOLDER, refuses
from slow_readers import corners, drawn
from splat_transform_programs import needs_program

from gsmerge import Gaussians, Scene
from gsmerge.cli import main
from gsmerge.errors import SceneError, UsageError
from gsmerge.geometry import normalize
from gsmerge.io import output_format, read_gaussians, read_ply, write_gaussians
from gsmerge.io.atomic import temporary_path
from gsmerge.io.formats import sog, streamed
from gsmerge.io.formats.arrays import Columns
from gsmerge.io.formats.splat_transform import find_program
from gsmerge.io.formats.streamed import read_level, write_levels
from gsmerge.kernels import elementary

from .test_sog import webp
from .test_write import psnr

COUNTS = (900, 230, 55)
SPACING = 1.0  # of the grid that centres are on: a chunk rounds them by far less
LONGEST = 0.3  # standard deviation


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks of a few Gaussians."""
    monkeypatch.setattr(streamed, "CHUNK_SIZE", 160)
    monkeypatch.setattr(streamed, "LEAF_SIZE", 70)


def on_grid(count: int, seed: int) -> Gaussians:
    """Turned Gaussians on distinct places of a flat grid, by which each is known again."""
    rng = np.random.default_rng(seed)
    places = rng.permutation(40 * 40 * 4)[:count]
    means = SPACING * np.stack([places % 40 - 20, places // 40 % 40 - 20, places // 1600], 1).astype(np.float32)
    quats = normalize(rng.normal(size=(count, 4)).astype(np.float32))
    scales = rng.uniform(0.01, LONGEST, (count, 3)).astype(np.float32)
    sh0 = rng.normal(size=(count, 1, 3)).astype(np.float32)
    return Gaussians(means, quats, scales, rng.uniform(size=count).astype(np.float32), sh0, sh0[:, :0])


def chain(seed: int = 0) -> list[Gaussians]:
    return [on_grid(count, seed + level) for level, count in enumerate(COUNTS)]


def leaves_of(node: dict[str, Any]) -> list[dict[str, Any]]:
    """The leaves below a node, after a look at every node on the way."""
    assert set(node["bound"]) == {"min", "max"}
    assert all(low <= high for low, high in zip(node["bound"]["min"], node["bound"]["max"], strict=True))
    assert ("children" in node) != ("lods" in node)
    if "lods" in node:
        return [node]
    for end, pick in {"min": min, "max": max}.items():
        ends = [child["bound"][end] for child in node["children"]]
        assert node["bound"][end] == [pick(column) for column in zip(*ends, strict=True)]
    return [leaf for child in node["children"] for leaf in leaves_of(child)]


def columns_of(chunk: Path) -> Columns:
    packed = sog.read_unbundled(chunk).packed
    return packed.unpack(slice(0, packed.count))


def check_dataset(index: Path, levels: list[Gaussians]) -> dict[str, Any]:
    """Check all that the specification says of a dataset, and that it has each Gaussian of each level once."""
    document: dict[str, Any] = json.loads(index.read_text())
    counts = [len(level) for level in levels]
    assert (index.name, document["version"], document["lodLevels"]) == ("lod-meta.json", 1, len(levels))
    assert (document["count"], document["counts"]) == (sum(counts), counts)
    assert len(set(document["filenames"])) == len(document["filenames"])
    chunks = []
    for name in document["filenames"]:
        folder, file = name.split("/")
        assert (file, (index.parent / folder).is_dir()) == ("meta.json", True)
        meta = json.loads((index.parent / name).read_text())
        assert meta["version"] == 2
        textures = {file for part in meta.values() if isinstance(part, dict) for file in part.get("files", [])}
        assert {one.name for one in (index.parent / folder).iterdir()} == {"meta.json", *textures}
        chunks.append(columns_of(index.parent / name))
        assert len(chunks[-1]) == meta["count"]
    taken = [np.zeros(len(chunk), int) for chunk in chunks]
    kind: dict[int, str] = {}
    seen: dict[str, list[np.ndarray]] = {str(level): [] for level in range(len(levels))}
    for leaf in leaves_of(document["tree"]):
        low, high = (np.array(leaf["bound"][end]) for end in ("min", "max"))
        assert set(leaf["lods"]) <= set(seen)
        for level, run in leaf["lods"].items():
            assert set(run) == {"file", "offset", "count"}
            assert all(type(value) is int for value in run.values())
            assert kind.setdefault(run["file"], level) == level  # a chunk has one level
            rows = slice(run["offset"], run["offset"] + run["count"])
            assert 0 < run["count"] <= len(chunks[run["file"]]) - run["offset"]
            taken[run["file"]][rows] += 1
            means = chunks[run["file"]].means[rows]
            assert ((low <= means) & (means <= high)).all()
            seen[level].append(means)
    assert all((one == 1).all() for one in taken)  # without gaps and overlaps
    for level, means in zip(levels, seen.values(), strict=True):
        places = np.rint(np.concatenate(means) / SPACING) * SPACING
        assert np.abs(places - np.concatenate(means)).max() < SPACING / 100
        np.testing.assert_array_equal(np.unique(places, axis=0), np.unique(np.asarray(level.means), axis=0))
        assert len(places) == len(level)
    return document


def test_a_dataset_is_as_specified(tmp_path: Path, small: None) -> None:
    levels, index = chain(), tmp_path / "scene" / "lod-meta.json"
    write_levels(index, levels)
    document = check_dataset(index, levels)
    leaves = leaves_of(document["tree"])
    assert len(leaves) >= sum(COUNTS) / streamed.LEAF_SIZE
    assert [name[:3] for name in document["filenames"]] == [*(f"0_{i}" for i in range(len(document["filenames"]) - 3)),
                                                          "1_0", "1_1", "2_0"]  # fmt: skip
    longest = max(run["count"] for leaf in leaves for run in leaf["lods"].values())
    assert longest <= streamed.LEAF_SIZE
    sizes = [json.loads((index.parent / name).read_text())["count"] for name in document["filenames"]]
    assert max(sizes) <= streamed.CHUNK_SIZE < 2 * min(sizes[:5])


def test_boxes_hold_the_whole_ellipsoids(tmp_path: Path, small: None) -> None:
    levels, index = [on_grid(300, 3)], tmp_path / "lod-meta.json"
    write_levels(index, levels)
    document = check_dataset(index, levels)
    for leaf in leaves_of(document["tree"]):
        run = leaf["lods"]["0"]
        chunk = columns_of(tmp_path / document["filenames"][run["file"]])
        rows = slice(run["offset"], run["offset"] + run["count"])
        for mean, quat, logs in zip(chunk.means[rows], chunk.quats[rows], chunk.log_scales[rows], strict=True):
            w, x, y, z = quat
            turn = np.array([
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ])  # fmt: skip
            reach = 0.98 * np.sqrt(np.diag(turn @ np.diag(elementary.exp(2 * logs)) @ turn.T))  # but for the rounding
            assert (mean - reach >= leaf["bound"]["min"]).all()
            assert (mean + reach <= leaf["bound"]["max"]).all()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(2, 96, 72))


@pytest.mark.parametrize("degree", [0, 3])
def test_a_small_level_is_the_sog_of_the_same(degree: int, scene: Scene, tmp_path: Path) -> None:
    gaussians = drawn(scene, degree)
    write_levels(tmp_path / "lod-meta.json", [gaussians, gaussians[::4]], comments=["SplatRenderMode: mip"])
    for level, own in enumerate((gaussians, gaussians[::4])):
        write_gaussians(tmp_path / "a.sog", own, overwrite=True)
        expected, actual = read_gaussians(tmp_path / "a.sog"), read_level(tmp_path / "lod-meta.json", level)
        for name, array in vars(expected.gaussians).items():
            np.testing.assert_array_equal(getattr(actual.gaussians, name), array, name)
        assert actual.info.comments == ("SplatRenderMode: mip",)
    assert len(read_gaussians(tmp_path / "lod-meta.json").gaussians) == len(gaussians)


@pytest.mark.parametrize("degree", [0, 3])
def test_many_chunks_show_the_same(degree: int, scene: Scene, tmp_path: Path, small: None) -> None:
    gaussians, index = drawn(scene, degree), tmp_path / "lod-meta.json"
    write_levels(index, [gaussians])
    ply = read_gaussians(index)
    assert psnr(scene, gaussians, ply.gaussians) > {0: 42, 3: 35}[degree]
    assert ply.info.file_bytes == sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    assert ply.info.layout == f"Streamed SOG version 1, {len(gaussians):,} Gaussians at 1 level(s), SH degree {degree}"


@needs_program()
def test_splat_transform_reads_the_same(scene: Scene, tmp_path: Path, small: None) -> None:
    gaussians, index, back = drawn(scene, 1), tmp_path / "lod-meta.json", tmp_path / "back.ply"
    write_levels(index, [gaussians, gaussians[::4], gaussians[::16]])
    for level in range(3):
        command = [find_program(), "-q", "-w", "-g", "cpu", "-L", str(level), str(index), str(back)]
        subprocess.run(command, check=True, capture_output=True)
        expected, actual = read_level(index, level).gaussians, read_ply(back).gaussians
        assert (len(actual), actual.sh_degree) == (len(expected), 1)
        assert psnr(scene, expected, actual) > 50


@needs_program()
def test_what_splat_transform_writes_is_read(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With a tree, an environment and names of its own."""
    gaussians, index = drawn(scene, 1), tmp_path / "scene" / "lod-meta.json"
    paths = {level: tmp_path / f"{level}.ply" for level in (0, 1, -1)}
    for level, path in paths.items():
        write_gaussians(path, gaussians[:: {0: 1, 1: 4, -1: 50}[level]])
    tagged = [part for level, path in paths.items() for part in (str(path), "--tag-lod", str(level))]
    subprocess.run([find_program(), "-q", "-g", "cpu", *tagged, str(index)], check=True, capture_output=True)
    actual = read_gaussians(index).gaussians
    assert len(actual) == len(gaussians) + len(gaussians[::50])
    assert len(read_level(index, 1).gaussians) == len(gaussians[::4])
    assert main(["inspect", str(index)]) == 0
    assert capsys.readouterr().out.startswith("file ")


def test_places_that_cannot_be_told_apart_stay_together(tmp_path: Path, small: None) -> None:
    means = np.zeros((300, 3), np.float32)
    means[:40, 1] = 1
    one = on_grid(300, 0)
    here = Gaussians(means, one.quats, one.scales, one.opacities, one.sh0, one.shN)
    write_levels(tmp_path / "lod-meta.json", [here])
    tree = json.loads((tmp_path / "lod-meta.json").read_text())["tree"]
    assert [leaf["lods"]["0"]["count"] for leaf in leaves_of(tree)] == [260, 40]
    assert len(read_gaussians(tmp_path / "lod-meta.json").gaussians) == 300


def test_extremes_and_single_gaussians(tmp_path: Path) -> None:
    write_levels(tmp_path / "lod-meta.json", [corners(), corners()[:1]])
    assert main(["inspect", str(tmp_path / "lod-meta.json"), "-q"]) == 0
    for array in vars(read_gaussians(tmp_path / "lod-meta.json").gaussians).values():
        assert np.isfinite(array).all()


def content(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_failures_leave_existing_files_and_nothing_else(tmp_path: Path) -> None:
    index = tmp_path / "scene" / "lod-meta.json"
    bad = corners()
    bad.opacities[1] = np.nan
    for levels, words in (([corners(), bad], "finite"), ([corners(), bad[:0]], "none")):
        with pytest.raises(ValueError, match=words):
            write_levels(index, levels)
    assert list(tmp_path.iterdir()) == []
    write_levels(index, [corners()])
    before = content(tmp_path)
    with refuses(SceneError, "lod-meta.json", "exists"):
        write_levels(index, chain())
    with refuses(ValueError, "", "finite", 1):
        write_levels(index, [bad], overwrite=True)
    assert content(tmp_path) == before
    with refuses(SceneError, "scene", *NO_FOLDER):
        write_levels(index / "scene" / "lod-meta.json", [corners()])
    with refuses(UsageError, "levels.json", "lod-meta.json"):
        write_levels(tmp_path / "levels.json", [corners()])


@pytest.mark.parametrize("first", [chain(7), [corners()]], ids=["many", "one"])
def test_a_dataset_is_replaced_whole(first: list[Gaussians], tmp_path: Path, small: None) -> None:
    """The chunks of the old one go, whatever else is in the folder stays."""
    index, alone = tmp_path / "scene" / "lod-meta.json", tmp_path / "alone" / "lod-meta.json"
    write_levels(index, first)
    theirs = {"0_0/meta.json": b"another program's", "notes.txt": b"mine", "0_9-01234567/meta.json": b"{}"}
    mine = f"{streamed.read_index(index).levels[0].popitem()[0].parent.name}/notes.txt"
    for name, data in {**theirs, mine: b"mine"}.items():
        (index.parent / name).parent.mkdir(exist_ok=True)
        (index.parent / name).write_bytes(data)
    write_levels(index, chain(), overwrite=True)
    write_levels(alone, chain())  # as the same bytes
    assert content(index.parent) == {**content(alone.parent), **theirs, mine: b"mine"}
    check_dataset(index, chain())


def test_errors_and_environment(tmp_path: Path, small: None) -> None:
    """Every leaf has an error for each level; what the environment holds is read with the finest level alone."""
    index, levels, sky = tmp_path / "lod-meta.json", chain(), corners()

    def measure(leaves: Sequence[streamed.Leaf]) -> np.ndarray:
        return np.arange(len(leaves))[:, None] + np.array([0, 1 / 3, 2e-5])

    for files in (streamed.streamed_files(levels, environment=sky, measure=measure), streamed.streamed_files(levels)):
        for name, data in files.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_bytes(data)
        document = json.loads(index.read_text())
        streamed.remove_unused_chunks(index)
        assert len(list(tmp_path.glob("env-*"))) == document["lodErrors"]
        if document["lodErrors"]:
            leaves = leaves_of(document["tree"])
            assert [leaf["errors"][1] for leaf in leaves[:2]] == [0.3333, 1.333]
            assert len(leaves) > 2
            assert document["counts"] == list(COUNTS)
            assert [len(read_level(index, level).gaussians) for level in (0, 1)] == [COUNTS[0] + len(sky), COUNTS[1]]
    check_dataset(index, levels)


def test_the_rest_of_killed_runs_is_removed(tmp_path: Path) -> None:
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    left = temporary_path(tmp_path / "0_0-89abcdef" / "meta.json")
    left.parent.mkdir()
    left.with_name(left.name.replace(f"-{os.getpid()}-", f"-{int(dead.stdout)}-")).touch()
    write_levels(tmp_path / "lod-meta.json", [corners()])
    assert not left.parent.exists()


@pytest.mark.parametrize("call", [0, 8, 24])
def test_an_index_names_no_chunk_that_is_not_there(
    call: int, tmp_path: Path, small: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever rename fails: the old dataset is whole, and so is the new one after the next run."""
    index, replace, calls = tmp_path / "lod-meta.json", os.replace, iter(range(1000))
    old, new = [on_grid(120, 8)], [on_grid(400, 9), on_grid(60, 10)]
    write_levels(index, old)

    def rename(*paths: Any) -> None:
        if next(calls) == call:
            raise OSError(errno.EIO, "Input/output error")
        replace(*paths)

    monkeypatch.setattr(os, "replace", rename)
    with refuses(SceneError, "", "Input/output error"):
        write_levels(index, new, overwrite=True)
    check_dataset(index, old)
    write_levels(index, new, overwrite=True)
    check_dataset(index, new)
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} == {
        chunk.parent.name for level in streamed.read_index(index).levels for chunk in level
    }


def test_the_name_chooses_the_format_where_levels_are_written() -> None:
    assert output_format("scene/lod-meta.json", levels=True).ending == "lod-meta.json"
    for name, levels in {"scene/lod-meta.json": False, "my-lod-meta.json": True, "LOD-meta.json": True}.items():
        with refuses(UsageError, name, ".ply", ".glb"):
            output_format(name, levels=levels)


def _edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def _fewer(index: dict[str, Any], _: Path) -> None:
    """A count that agrees with all of the index, and not with the chunk."""
    index["tree"]["lods"]["0"]["count"] = 2
    index.update(count=3, counts=[2, 1])


def _link_out(index: dict[str, Any], folder: Path) -> None:
    chunk = (folder / index["filenames"][0]).parent
    chunk.rename(folder.parent / "outside")
    chunk.symlink_to(folder.parent / "outside")


Change = Callable[[dict[str, Any], Path], object]
DAMAGED: dict[str, Change] = {
    "version": lambda index, _: index.update(version=2),
    "no version": lambda index, _: index.update(version=[]),
    "no levels": lambda index, _: index.update(lodLevels=1),
    "no tree": lambda index, _: index.update(tree=[]),
    "both": lambda index, _: index["tree"].update(children=[]),
    "turned": lambda index, _: index["tree"]["bound"].update(min=[9, 9, 9], max=[1, 1, 1]),
    "nan": lambda index, _: index["tree"]["bound"].update(min=[float("nan")] * 3),
    "count": lambda index, _: index.update(count=5),
    "file": lambda index, _: index["tree"]["lods"]["0"].update(file=2),
    "true": lambda index, _: index["tree"]["lods"]["0"].update(offset=True),
    "gap": lambda index, _: index["tree"]["lods"]["0"].update(offset=1),
    "word": lambda index, _: index["tree"]["lods"].update(finest={}),
    "shared": lambda index, _: index["tree"]["lods"]["1"].update(file=0),
    "above": lambda index, _: index["filenames"].append("../lod-meta.json"),
    "windows": lambda index, _: index["filenames"].append("..\\meta.json"),
    "kind": lambda index, _: index["filenames"].append("0_0/other.json"),
    "far": lambda index, _: index.update(environment="../meta.json"),
    "link": _link_out,
    "absent": lambda index, folder: shutil.rmtree(folder / Path(index["filenames"][0]).parent),
    "texture": lambda index, folder: (folder / index["filenames"][0]).with_name("quats.webp").unlink(),
    "pixels": lambda index, folder: (folder / index["filenames"][0]).with_name("scales.webp").write_bytes(
        webp(4096, 4096)
    ),
    "fewer": _fewer,
    "escape": lambda index, folder: _edit(
        folder / index["filenames"][0], lambda meta: meta["quats"].update(files=["../../etc/passwd"])
    ),
    "promise": lambda index, folder: _edit(folder / index["filenames"][0], lambda meta: meta.update(count=10**15)),
    "first": lambda index, folder: _edit(folder / index["filenames"][0], lambda meta: meta.pop("version")),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_is_one_line(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene" / "lod-meta.json"
    write_levels(path, [corners(), corners()[:1]])
    index = json.loads(path.read_text())
    DAMAGED[name](index, path.parent)
    path.write_text(json.dumps(index))
    with pytest.raises(SceneError):
        read_gaussians(path)
    assert main(["inspect", str(path)]) == 3
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1, captured.err
    assert "Traceback" not in captured.err


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", "7", "[" * 100_000, '{"version": 1, "filenames": [], "lodLevels": 1}']
)
def test_another_file_of_that_name_is_one_line(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "lod-meta.json").write_text(text)
    assert main(["inspect", str(tmp_path / "lod-meta.json")]) == 3
    assert capsys.readouterr().err.count("\n") == 1


def test_a_deep_tree_is_read(tmp_path: Path) -> None:
    write_levels(tmp_path / "lod-meta.json", [corners()])

    def deepen(index: dict[str, Any]) -> None:
        for _ in range(300):
            index["tree"] = {"bound": index["tree"]["bound"], "children": [index["tree"]]}

    _edit(tmp_path / "lod-meta.json", deepen)
    assert len(read_gaussians(tmp_path / "lod-meta.json").gaussians) == 3


def test_check_reads_all_levels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_levels(tmp_path / "lod-meta.json", [corners(), corners()[:1]])
    assert main(["inspect", str(tmp_path / "lod-meta.json")]) == 0
    assert "3 + 1 Gaussians at 2 level(s)" in capsys.readouterr().out
    second = next(iter(streamed.read_index(tmp_path / "lod-meta.json").levels[1]))
    second.with_name("sh0.webp").unlink()
    assert len(read_gaussians(tmp_path / "lod-meta.json").gaussians) == 3
    assert main(["inspect", str(tmp_path / "lod-meta.json")]) == 3
    assert f"{second.with_name('sh0.webp')}: no such file" in capsys.readouterr().err


def test_files_before_versions_are_read(tmp_path: Path) -> None:
    write_levels(tmp_path / "lod-meta.json", [corners()])

    def forget(index: dict[str, Any]) -> None:
        for key in ("version", "asset", "count", "counts"):
            del index[key]
        index["environment"] = None

    _edit(tmp_path / "lod-meta.json", forget)
    assert len(read_gaussians(tmp_path / "lod-meta.json").gaussians) == 3
