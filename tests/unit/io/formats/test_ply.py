"""PLY files are opened with their header checked, and read though they change."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import scenes
from former_formats import compressed_bytes
from messages import refuses

from gsmerge import write_ply
from gsmerge.errors import SceneError, list_doubts
from gsmerge.io import read_gaussians, read_ply
from gsmerge.io.formats import ply
from gsmerge.io.formats.ply import COMMENT_BYTES, count_for_bytes, file_bytes, header_counts, open_ply
from gsmerge.io.formats.read_gaussians import file_notes, read_parts
from gsmerge.io.formats.rows import FileRows
from gsmerge.io.formats.table import estimate_counts

from .test_read_gaussians import columns, save


@pytest.mark.parametrize("comment", [b"caf\xe9", "caf\N{LATIN SMALL LETTER E WITH ACUTE}".encode(), b"\xff" * 100])
@pytest.mark.parametrize("text", [True, False])
def test_comments_may_hold_any_byte(tmp_path: Path, comment: bytes, text: bool) -> None:
    path = save(tmp_path / "a.ply", columns(), text=text)
    expected, (head, rows) = read_ply(path).gaussians, path.read_bytes().split(b"element", 1)
    path.write_bytes(head + b"comment " + comment + b"\nobj_info " + comment + b"\nelement" + rows)
    scene = read_ply(path)
    assert np.array_equal(scene.gaussians.means, expected.means)
    assert all(kept.isascii() for kept in scene.info.comments)


@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
def test_empty_lines_between_rows_of_text_are_passed_over(tmp_path: Path, newline: bytes) -> None:
    path = save(tmp_path / "a.ply", columns(), text=True)
    expected, (head, rows) = read_ply(path).gaussians, path.read_bytes().split(b"end_header\n", 1)
    spaced = b"\n \t\n" + rows.replace(b"\n", b"\n\n\n") + b"\n\n"
    path.write_bytes((head + b"end_header\n" + spaced).replace(b"\n", newline))
    assert np.array_equal(read_ply(path).gaussians.means, expected.means)


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "packed"])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.9])
def test_a_ply_that_shrinks_while_it_is_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float, packed: bool
) -> None:
    path = tmp_path / ("a.compressed.ply" if packed else "a.ply")
    if packed:
        path.write_bytes(compressed_bytes(read_ply(save(tmp_path / "b.ply", columns(20_000))).gaussians))
    else:
        save(path, columns(20_000))
    size, parse = path.stat().st_size, ply.open_ply

    def open_then_cut(opened: Path) -> tuple[ply.Header, int]:
        header = parse(opened)
        os.truncate(path, round(share * size))
        return header

    monkeypatch.setattr(ply, "open_ply", open_then_cut)
    with refuses(SceneError, f"{path}: truncated or damaged", "shorter"):
        read_ply(path)


@pytest.mark.parametrize("block", [slice(0, 7), slice(7, 12_345), slice(12_345, 20_000), slice(None)], ids=str)
def test_rows_read_in_blocks_are_those_of_the_file(tmp_path: Path, block: slice) -> None:
    rows, path = columns(20_000), tmp_path / "a.ply"
    stored = open_ply(save(path, rows))[0].elements["vertex"].rows
    assert isinstance(stored, FileRows)
    np.testing.assert_array_equal(stored[block], rows[block])


def test_rows_of_a_file_that_replaces_another_are_not_mixed_with_those_of_the_other(tmp_path: Path) -> None:
    stored = open_ply(save(tmp_path / "a.ply", columns(6)))[0].elements["vertex"].rows
    save(tmp_path / "b.ply", columns(6)).replace(tmp_path / "a.ply")
    with refuses(SceneError, "a.ply", "replaced"):
        _ = stored[0:3]


@pytest.mark.parametrize("kind", ["binary", "text", "packed"])
@pytest.mark.parametrize(
    ("more", "is_doubtful"), [("none", False), ("newline", False), ("padding", False), ("row", True), ("file", True)]
)
def test_more_than_padding_after_the_last_row_is_a_doubt(
    tmp_path: Path, kind: str, more: str, is_doubtful: bool
) -> None:
    """Elements after the vertices are none: the packed harmonics follow them."""
    path = save(tmp_path / "a.ply", columns(300, num_rest=45), text=kind == "text")
    if kind == "packed":
        path.write_bytes(compressed_bytes(read_ply(path).gaussians))
    content = path.read_bytes()
    row = content[-16:] if kind == "packed" else content[-62 * 4 :] if kind == "binary" else content.splitlines()[-1]
    added = {"none": b"", "newline": b"\n", "padding": b"\n" * 7, "row": row, "file": content}[more]
    path.write_bytes(content + added)
    doubts = [doubt for doubt in list_doubts(file_notes(read_ply(path).info)) if "bytes follow" in doubt]
    assert [doubt.split()[0] for doubt in doubts] == [f"{len(added.strip()):,}"] * is_doubtful


def test_bytes_after_any_of_several_parts_are_a_doubt(tmp_path: Path) -> None:
    """Not only by the first one."""
    paths = [save(tmp_path / f"{name}.ply", columns(50)) for name in "ab"]
    paths[1].write_bytes(paths[1].read_bytes() + bytes(100))
    assert any("100 bytes follow" in note for note in list_doubts(file_notes(read_parts(paths).info)))


def test_counts_are_read_from_a_header(tmp_path: Path) -> None:
    assert header_counts(save(tmp_path / "a.ply", columns(7))) == (7, 0)
    assert header_counts(save(tmp_path / "b.ply", columns(9, num_rest=45))) == (9, 45)
    assert header_counts(save(tmp_path / "c.ply", columns(3, num_rest=9), text=True)) == (3, 9)
    (tmp_path / "d.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nend_header\nelement vertex 5\n")
    assert header_counts(tmp_path / "d.ply") == (0, 0)
    assert header_counts(tmp_path / "none.ply") == (0, 0)
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.ply")  # which nobody writes to
        assert header_counts(tmp_path / "pipe.ply") == (0, 0)


PLAIN, LINES = [b"property float " + name for name in (b"x", b"y", b"z", b"w")], b"\n".join


@pytest.mark.parametrize(
    ("stated", "properties", "rows", "text", "held"),
    [
        (b"7", PLAIN, 7 * 16, False, (7, 0)), (b"8", PLAIN, 7 * 16, False, (0, 0)),
        (b"999999999999", PLAIN, 7 * 16, False, (0, 0)), (b"9" * 5000, PLAIN, 7 * 16, False, (0, 0)),
        (b"-7", PLAIN, 7 * 16, False, (0, 0)), (b"7", [], 7 * 16, False, (0, 0)),
        (b"7", PLAIN, 7 * 8, True, (7, 0)), (b"8", PLAIN, 7 * 8, True, (0, 0)),
        (b"7", [b"property double f_rest_0", b"property uchar f_rest_1"], 7 * 9, False, (7, 2)),
        (b"7", [b"property double f_rest_0", b"property uchar f_rest_1"], 7 * 9 - 2, False, (0, 0)),
        (b"7", [b"property list uchar float x"], 7 * 16, False, (0, 0)),
        (b"7", [b"property uchar f_rest_%d" % i for i in range(500)], 7 * 500, False, (7, 72)),
    ],
)  # fmt: skip
def test_counts_of_a_header_hold_where_its_bytes_are_enough(
    tmp_path: Path, stated: bytes, properties: list[bytes], rows: int, text: bool, held: tuple[int, int]
) -> None:
    kind = b"ascii" if text else b"binary_little_endian"
    head = [b"ply", b"format " + kind + b" 1.0", b"element vertex " + stated, *properties, b"end_header", b""]
    (tmp_path / "a.ply").write_bytes(LINES(head) + bytes(rows))
    assert header_counts(tmp_path / "a.ply", check_size=True) == held
    assert estimate_counts([tmp_path / "a.ply"] * 2) == (2 * held[0], held[1])


def test_tensors_of_lyra_1_are_refused_with_the_remedy(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    torch.save(torch.zeros(1, 5, 14), tmp_path / "gaussians_0.ply")
    with refuses(SceneError, "gaussians_0.ply", "torch.save", "Lyra 1", "save_gaussians_orig: true"):
        read_ply(tmp_path / "gaussians_0.ply")


def test_all_missing_columns_are_named(tmp_path: Path) -> None:
    """Two scales without a third are those of flat Gaussians; a page is written and not read."""
    points = save(tmp_path / "a.ply", columns(names=("x", "y", "z", "red", "green", "blue")))
    with refuses(SceneError, points, "columns opacity, scale_0, scale_1, scale_2, rot_0"):
        read_ply(points)
    with refuses(SceneError, "a.html", ".compressed.ply, .ply, .spz", ".gsm", "meta.json"):
        read_gaussians(tmp_path / "a.html")


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("count", [1, 9, 10, 144])
def test_file_bytes_are_the_size_of_the_written_file(count: int, tmp_path: Path, degree: int) -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(1, 16, 9), degree=degree)
    write_ply(tmp_path / f"{count}.ply", scene.gaussians[:count])
    assert (tmp_path / f"{count}.ply").stat().st_size == file_bytes(count, degree)


@pytest.mark.parametrize("degree", range(5))
def test_count_for_bytes_is_the_most_that_fits(degree: int) -> None:
    sizes = [file_bytes(1, degree), 10_000, 68_000, 68_001, 5_000_000]
    sizes += [file_bytes(10**k, degree) - d for k in (1, 2, 5) for d in (0, 1, 2)]
    for size in sizes:
        if size >= file_bytes(1, degree):
            count = count_for_bytes(size + COMMENT_BYTES, degree)
            assert file_bytes(count, degree) <= size < file_bytes(count + 1, degree)


def test_sizes_and_degrees_out_of_range_have_no_count() -> None:
    with refuses(ValueError, "budget", 502 + COMMENT_BYTES, 100):
        count_for_bytes(100, 0)
    with refuses(ValueError, "sh_degree", "0 to 4", 5):
        count_for_bytes(10**6, 5)
