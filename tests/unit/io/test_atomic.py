from __future__ import annotations

import errno
import itertools
import os
import re
import stat
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from messages import NO_FOLDER, refuses

from gsmerge.errors import SceneError
from gsmerge.io import atomic_output, atomic_outputs
from gsmerge.io.atomic import common_mode, remove_stale, temporary_path


def write_half_and_fail(path: Path, error: BaseException) -> None:
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text("half")
        raise error


def test_an_output_takes_its_name_when_it_is_finished(tmp_path: Path) -> None:
    with atomic_output(tmp_path / "out.png") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".png"
        assert not (tmp_path / "out.png").exists()
        temporary.write_text("done")
    assert [p.name for p in tmp_path.iterdir()] == ["out.png"]
    assert (tmp_path / "out.png").read_text() == "done"


@pytest.mark.parametrize("error", [RuntimeError("boom"), KeyboardInterrupt()])
@pytest.mark.parametrize("earlier", [[], ["out.txt"]])
def test_a_failure_while_writing_leaves_the_earlier_file(
    tmp_path: Path, error: BaseException, earlier: list[str]
) -> None:
    for name in earlier:
        (tmp_path / name).write_text("old")
    with pytest.raises(type(error)):
        write_half_and_fail(tmp_path / "out.txt", error)
    assert [path.name for path in tmp_path.iterdir()] == earlier
    assert all((tmp_path / name).read_text() == "old" for name in earlier)


def test_an_existing_file_is_replaced_with_overwrite_alone(tmp_path: Path) -> None:
    target = tmp_path / "out.txt"
    target.write_text("old")
    with pytest.raises(SceneError, match="exists already"), atomic_output(target) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "old"
    with atomic_output(target, overwrite=True) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new"


def test_missing_folders_stay_only_below_a_finished_output(tmp_path: Path) -> None:
    with atomic_output(tmp_path / "a" / "b" / "out.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a" / "b" / "out.txt").read_text() == "new"
    with pytest.raises(ZeroDivisionError), atomic_output(tmp_path / "a" / "c" / "d" / "out.txt"):
        raise ZeroDivisionError
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b"]


def test_outputs_below_a_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for place, named in (("file/out.txt", "out.txt"), ("file/deeper/out.txt", "deeper")):
        with refuses(SceneError, named, *NO_FOLDER), atomic_output(tmp_path / place):
            pass


def test_an_output_in_the_place_of_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="found a folder"), atomic_output(tmp_path, overwrite=True):
        pass


def temporary_file_of(pid: int, path: Path) -> Path:
    """Return the temporary file of an output that a process has left."""
    ours = temporary_path(path)
    return ours.with_name(ours.name.replace(f"-{os.getpid()}-", f"-{pid}-"))


def pid_of_ended_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.mark.skipif(os.name == "nt", reason="no call asks for a process there")
def test_only_temporary_files_of_dead_processes_are_removed(tmp_path: Path) -> None:
    dead = [
        temporary_file_of(pid_of_ended_process(), tmp_path / name)
        for name in ("out.ply", "other name.tar.gz", "no suffix")
    ]
    kept = [
        temporary_file_of(os.getpid(), tmp_path / "out.ply"),
        *(temporary_file_of(pid, tmp_path / "out.ply") for pid in (os.getppid(), 1)),
        tmp_path / ".out-00112233.ply",
    ]
    elsewhere = [temporary_file_of(pid_of_ended_process(), tmp_path / name) for name in ("out.ply", "old.ply")]
    recent, old = [path.with_name(re.sub("-[^-]+-", "-00000000-", path.name, count=1)) for path in elsewhere]
    for path in (*dead, *kept, recent, old):
        path.touch()
    os.utime(old, (0, 0))
    with atomic_output(tmp_path / "out.ply"):
        pass
    assert sorted(tmp_path.iterdir()) == sorted([*kept, recent, tmp_path / "out.ply"])


@pytest.mark.skipif(sys.platform != "linux", reason="states of processes as Linux shows them")
def test_temporary_files_of_a_zombie_process_are_removed(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        left = temporary_file_of(process.pid, tmp_path / "out.ply")
        left.touch()
        remove_stale(tmp_path)
        assert not left.exists()


def write_both(folder: Path, second: str, *, fail: bool = False) -> None:
    with atomic_outputs(overwrite=True) as add:
        add(folder / "a.txt").write_text("new")
        temporary = add(folder / second)
        temporary.write_text("new")
        if fail:
            raise OSError(errno.ENOSPC, "No space left on device", str(temporary))


def test_several_outputs_are_all_written_or_none(tmp_path: Path) -> None:
    (tmp_path / "b.txt").write_text("old")
    with refuses(SceneError, "b.txt", "No space left"):
        write_both(tmp_path, "b.txt", fail=True)
    with refuses(SceneError, "b.txt", "No space left"):
        write_both(tmp_path, "none/b.txt", fail=True)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"b.txt": "old"}
    write_both(tmp_path, "b.txt")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"a.txt": "new", "b.txt": "new"}


def fail_at(monkeypatch: pytest.MonkeyPatch, call: int, error: BaseException) -> None:
    """Let the rename of that number fail, counted from 0."""
    replace, calls = os.replace, itertools.count()

    def rename(*paths: Any) -> None:
        if next(calls) == call:
            raise error
        replace(*paths)

    monkeypatch.setattr(os, "replace", rename)


def write_three(folder: Path, *, overwrite: bool = True) -> None:
    with atomic_outputs(overwrite=overwrite) as add:
        for name in ("a.txt", "b.txt", "c.txt"):
            add(folder / name).write_text("new")


def texts_of_three(folder: Path) -> list[str | None]:
    """Return the texts of the three files, after a look that nothing else is there."""
    names = ["a.txt", "b.txt", "c.txt"]
    assert {path.name for path in folder.iterdir()} <= set(names)
    return [(folder / name).read_text() if (folder / name).exists() else None for name in names]


@pytest.mark.parametrize("call", [0, 1, 2])
def test_a_rename_that_fails_leaves_each_file_old_or_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: int
) -> None:
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text("old")
    fail_at(monkeypatch, call, OSError(errno.EIO, "Input/output error"))
    with refuses(SceneError, "a.txt", "Input/output error"):
        write_three(tmp_path)
    assert texts_of_three(tmp_path) == ["new"] * call + ["old", "old", None][call:]


@pytest.mark.parametrize("linked", [True, False], ids=["links", "no links"])
def test_a_name_that_appears_meanwhile_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, linked: bool
) -> None:
    """Whoever renames first keeps the name, and nothing of the other is left."""
    if not linked:
        monkeypatch.setattr(os, "link", Mock(side_effect=OSError(errno.EPERM, "Operation not permitted")))
    with refuses(SceneError, "b.txt", "exists already"), atomic_outputs() as add:
        for name in ("a.txt", "b.txt"):
            add(tmp_path / name).write_text("new")
        (tmp_path / "b.txt").write_text("another's")
    assert texts_of_three(tmp_path) == [None, "another's", None]


def test_an_output_inside_an_output_is_the_same_file(tmp_path: Path) -> None:
    with atomic_output(tmp_path / "a.txt") as outer, atomic_output(outer, overwrite=True) as inner:
        assert inner == outer
        inner.write_text("new")
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("inside", [False, True])
def test_a_disk_error_names_the_file_that_was_asked_for(tmp_path: Path, inside: bool) -> None:
    with (
        refuses(SceneError, "out.txt", "No space left"),
        atomic_output(tmp_path / "out.txt") if inside else nullcontext(tmp_path / "out.txt") as path,
    ):
        write_half_and_fail(path, OSError(errno.ENOSPC, "No space left on device"))
    assert list(tmp_path.iterdir()) == []


def test_data_is_flushed_to_the_disk_before_the_rename(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[str] = []
    flush, replace = os.fsync, os.replace

    def note_flush(descriptor: int) -> None:
        events.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        flush(descriptor)

    def note_rename(*paths: Any) -> None:
        events.append("rename")
        replace(*paths)

    monkeypatch.setattr(os, "fsync", note_flush)
    monkeypatch.setattr(os, "replace", note_rename)
    with atomic_outputs(overwrite=True) as add:
        for name in ("a.txt", "b.txt"):
            add(tmp_path / name).write_text("new")
    folder = [] if sys.platform == "win32" else ["folder"]  # whose names it cannot wait for
    assert events == ["file", "file", "rename", "rename", *folder]
    events.clear()
    with atomic_outputs(overwrite=True) as add:
        add(tmp_path / "index").write_text("new")
        add(tmp_path / "new" / "chunk").write_text("new")
    assert events == ["file", "file", *folder, "rename", *folder, "rename", *folder]  # the chunk before its index


@pytest.mark.skipif(os.name == "nt", reason="links as POSIX has them")
def test_an_output_at_a_link_replaces_the_target_of_the_link(tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "file.txt").write_text("old")
    for name, target, found in (("link.txt", "far/file.txt", "exists"), ("dangling.txt", "far/new.txt", "link to")):
        (tmp_path / name).symlink_to(target)
        with refuses(SceneError, tmp_path / name, found), atomic_output(tmp_path / name):
            pass
        with atomic_output(tmp_path / name, overwrite=True) as temporary:
            temporary.write_text("new")
        assert (tmp_path / name).is_symlink()
        assert (tmp_path / target).read_text() == "new"
    assert len(list(tmp_path.rglob("*"))) == 5


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_pipes_and_devices_are_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/null")):
        with refuses(SceneError, path, "pipe"), atomic_output(path, overwrite=True):
            pass


@pytest.mark.parametrize("name", ["a" * 251 + ".ply", "\N{SNOWMAN}" * 83 + ".ply", "a." + "b" * 250, "." + "a" * 254])
def test_names_of_outputs_may_be_as_long_as_systems_allow(tmp_path: Path, name: str) -> None:
    with atomic_output(tmp_path / name) as temporary:
        temporary.write_text("new")
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_an_output_of_a_longer_name_is_refused(tmp_path: Path) -> None:
    with refuses(SceneError, "a" * 300), atomic_output(tmp_path / ("a" * 300)):
        pass


def test_an_error_of_the_caller_is_raised_unchanged(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_output(tmp_path / "out.txt"):
        (tmp_path / "no such input").read_text()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs POSIX permissions")
def test_an_unwritable_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)  # permissions mean nothing to root, which tests may run as
    with refuses(SceneError, "o.ply", "Permission denied"), atomic_output(tmp_path / "o.ply"):
        pass
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == []


def test_new_outputs_have_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    with atomic_output(tmp_path / "atomic"):
        pass
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


posix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs POSIX permissions")


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def make_file(path: Path, mode: int) -> Path:
    path.write_text("old")
    path.chmod(mode)
    return path


@posix
@pytest.mark.parametrize("link", [False, True])
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o444, 0o666, 0o200, 0o000, 0o755])
def test_a_replaced_file_is_private_until_it_has_its_mode_again(tmp_path: Path, mode: int, link: bool) -> None:
    target = path = make_file(tmp_path / "out.txt", mode)
    if link:
        path = tmp_path / "link.txt"
        path.symlink_to(target)
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_text("new")
        assert mode_of(temporary) == 0o600
    assert mode_of(target) == mode
    target.chmod(0o600)
    assert target.read_text() == "new"


@posix
def test_an_output_has_the_mode_of_the_earlier_file_at_the_end(tmp_path: Path) -> None:
    """A run takes minutes, in which its owner may make a file private, or remove it."""
    with atomic_outputs(overwrite=True) as add:
        for name in ("changed", "gone"):
            add(make_file(tmp_path / name, 0o644)).write_text("new")
        (tmp_path / "changed").chmod(0o600)
        (tmp_path / "gone").unlink()
    assert [mode_of(tmp_path / name) for name in ("changed", "gone")] == [0o600, 0o600]


@posix
def test_new_files_have_no_rights_that_one_beside_them_lacked(tmp_path: Path) -> None:
    make_file(tmp_path / "index", 0o640)
    with atomic_outputs(overwrite=True) as add:
        for name in ("index", "chunk"):
            add(tmp_path / name).write_text("new")
    assert [mode_of(tmp_path / name) for name in ("index", "chunk")] == [0o640, 0o640]


@posix
@pytest.mark.parametrize(("modes", "umask", "expected"), [
    ([], 0o022, 0o644), ([0o644, 0o640], 0o022, 0o640), ([0o666], 0o027, 0o640), ([0o400], 0o022, 0o600),
    ([0o755], 0o000, 0o644), ([0o604, 0o640], 0o022, 0o600),
])  # fmt: skip
def test_a_new_file_has_at_most_the_rights_of_the_files_it_holds(
    tmp_path: Path, modes: list[int], umask: int, expected: int
) -> None:
    (tmp_path / "photos" / "deeper").mkdir(parents=True)
    for number, mode in enumerate(modes):
        make_file(tmp_path / "photos" / ("deeper" if number else ".") / f"{number}.png", mode)
    before = os.umask(umask)
    try:
        with atomic_output(tmp_path / "out", mode=common_mode([tmp_path / "photos", tmp_path / "gone"])) as temporary:
            assert mode_of(temporary) == expected
    finally:
        os.umask(before)
    assert mode_of(tmp_path / "out") == expected


@posix
@pytest.mark.parametrize(("refused", "mode", "expected"), [
    ([], 0o640, 0o640), (["owner"], 0o640, 0o640), (["owner"], 0o664, 0o664),  # as for a user who is in the group
    (["owner", "group"], 0o640, 0o600), (["owner", "group"], 0o664, 0o644), (["owner", "group"], 0o604, 0o604),
])  # fmt: skip
def test_owner_and_group_of_a_replaced_file_stay_where_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: list[str], mode: int, expected: int
) -> None:
    """Another group gets no rights that others do not have."""
    target, ask = make_file(tmp_path / "out.txt", mode), os.stat
    owner, group = 4321, 8765
    kept: dict[str, int] = {}

    def owned(path: Any, **options: Any) -> os.stat_result:
        status, is_old = ask(path, **options), Path(path) == target
        ids = (owner, group) if is_old else (kept.get("owner", status.st_uid), kept.get("group", status.st_gid))
        return os.stat_result((*status[:4], *ids, *status[6:]))

    def chown(path: str, uid: int, gid: int) -> None:
        assert Path(path) != target
        for name, value in {"owner": uid, "group": gid}.items():
            if name in refused and value != -1:
                raise PermissionError(errno.EPERM, "Operation not permitted")
            kept.update({name: value} if value != -1 else {})

    monkeypatch.setattr(os, "stat", owned)
    monkeypatch.setattr(os, "chown", chown)
    with atomic_output(target, overwrite=True) as temporary:
        temporary.write_text("new")
    monkeypatch.undo()
    assert kept == {name: {"owner": owner, "group": group}[name] for name in ("group", "owner") if name not in refused}
    assert mode_of(target) == expected
