from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from gsmerge.errors import SceneError
from gsmerge.io import atomic_output
from gsmerge.io.atomic import remove_leftovers


def write_half_and_fail(path: Path, error: BaseException) -> None:
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text("half")
        raise error


def write_while_another_does(path: Path) -> None:
    with atomic_output(path) as temporary:
        temporary.write_text("ours")
        path.write_text("theirs")


def test_a_finished_file_takes_its_name(tmp_path: Path) -> None:
    with atomic_output(tmp_path / "out.png") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".png"
        assert not (tmp_path / "out.png").exists()
        temporary.write_text("done")
    assert [p.name for p in tmp_path.iterdir()] == ["out.png"]
    assert (tmp_path / "out.png").read_text() == "done"


def test_a_failure_in_the_middle_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="boom"):
        write_half_and_fail(tmp_path / "out.txt", RuntimeError("boom"))
    assert list(tmp_path.iterdir()) == []


def test_a_failure_in_the_middle_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        write_half_and_fail(target, KeyboardInterrupt())
    assert [p.name for p in tmp_path.iterdir()] == ["out.txt"]
    assert target.read_text() == "old"


def test_an_existing_file_needs_overwrite(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")
    with pytest.raises(SceneError, match="exists already"), atomic_output(target) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "old"
    with atomic_output(target, overwrite=True) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new"


def test_a_file_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    with pytest.raises(SceneError, match="exists already"):
        write_while_another_does(target)
    assert [p.name for p in tmp_path.iterdir()] == ["out.txt"]
    assert target.read_text() == "theirs"


def test_a_missing_folder_and_a_folder_as_target_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="does not exist"), atomic_output(tmp_path / "no" / "out.txt"):
        pass
    with pytest.raises(SceneError, match="found a folder"), atomic_output(tmp_path, overwrite=True):
        pass


def test_a_disk_error_while_writing_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"out\.txt: could not be written \(No space left"):
        write_half_and_fail(tmp_path / "out.txt", OSError(errno.ENOSPC, "No space left on device"))
    assert list(tmp_path.iterdir()) == []


def test_what_a_writer_inside_says_names_the_file_that_was_asked_for(tmp_path: Path) -> None:
    """Writers that are atomic themselves know the temporary file only."""
    with pytest.raises(SceneError) as raised, atomic_output(tmp_path / "out.ply") as temporary:
        raise SceneError(temporary, "could not be written (No space left on device)")
    assert str(raised.value) == f"{tmp_path / 'out.ply'}: could not be written (No space left on device)"
    with pytest.raises(SceneError, match="other"), atomic_output(tmp_path / "out.ply"):
        raise SceneError(tmp_path / "other.ply", "no such file")


def test_leftovers_of_one_output_are_removed_and_nothing_else(tmp_path: Path) -> None:
    left = [".a[1]-00112233.ply", "..a[1]-00112233-44556677.ply"]
    others = [
        "a[1].ply",
        ".a[1]-0011223.ply",
        ".a1-00112233.ply",
        ".a[1]-00112233.png",
        ".b-00112233.ply",
        "a[1]-x.ply",
    ]
    for name in (*left, *others):
        (tmp_path / name).touch()
    remove_leftovers(tmp_path / "a[1].ply")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(others)
    with pytest.raises(SceneError, match="temporary files cannot be removed"):
        remove_leftovers(tmp_path / "gone" / "a.ply")


def test_an_error_of_the_caller_stays_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_output(tmp_path / "out.txt"):
        (tmp_path / "no such input").read_text()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs POSIX permissions")
def test_an_unwritable_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)  # permissions mean nothing to root, which tests may run as
    with pytest.raises(SceneError, match=r"cannot be written \(Permission denied\)"), atomic_output(tmp_path / "o.ply"):
        pass
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_files_get_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    with atomic_output(tmp_path / "atomic"):
        pass
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode
