"""Errors, in processes of a cluster."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import pytest

from gsmerge.errors import (
    OUT_OF_MEMORY,
    BatchError,
    Doubt,
    GsmergeError,
    Note,
    SceneError,
    TargetError,
    UsageError,
    attempt,
    count_words,
    list_doubts,
    name_notes,
    split_notes,
)


@pytest.mark.parametrize(
    "error",
    [SceneError("a.ply", "expected rows, found none", "export it again"), SceneError("a.ply", "no such file"),
     UsageError("no"), TargetError("not met"), BatchError("1 of 2 failed")],
)  # fmt: skip
def test_errors_can_be_pickled(error: GsmergeError) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)


def test_an_attempt_returns_a_result_or_the_error_of_a_scene() -> None:
    def refuse(path: str, *, problem: str) -> None:
        raise SceneError(path, problem, "name another")

    assert attempt(int, "3") == 3
    error = attempt(refuse, "a.ply", problem="expected rows, found none")
    assert isinstance(error, SceneError)
    assert (error.path, error.remedy) == ("a.ply", "name another")
    assert error.__traceback__ is None  # it would keep the arrays of the functions that were called
    with pytest.raises(ValueError, match="invalid literal"):
        attempt(int, "three")


def test_advice_for_all_commands_names_no_option() -> None:
    assert "--" not in OUT_OF_MEMORY


def test_views_without_names_are_named_once() -> None:
    assert str(SceneError("a.json", "view view 0: expected numbers")) == "a.json: view 0: expected numbers"


NOTES = [Note("not used: r", "columns", ["r"]), Doubt("is worse", "worse"), Doubt("is old"), "plain"]


def test_notes_are_chosen_by_what_they_are_about() -> None:
    assert split_notes(NOTES, "worse") == ([NOTES[1]], [NOTES[0], *NOTES[2:]])
    assert list_doubts(NOTES) == NOTES[1:3]


@pytest.mark.parametrize("change", [lambda notes: pickle.loads(pickle.dumps(notes)), lambda n: name_notes("a.ply", n)])
def test_notes_of_other_processes_and_files_keep_what_they_are_about(change: Callable[[list[str]], list[str]]) -> None:
    changed = change(NOTES)
    assert [type(note) for note in changed] == [Note, Doubt, Doubt, str]
    assert [(note.about, note.names) for note in changed if isinstance(note, Note)] == [
        ("columns", ("r",)), ("worse", ()), ("", ()),
    ]  # fmt: skip


def test_count_of_one_is_singular() -> None:
    numbers = 0, 1, 2, 1200
    assert [count_words(number, "row") for number in numbers] == ["0 rows", "1 row", "2 rows", "1,200 rows"]


def test_noun_that_ends_with_ch_takes_es() -> None:
    assert count_words(2, "batch") == "2 batches"


def test_words_behind_the_noun_stay_as_they_are() -> None:
    assert count_words(1, "empty row", "set aside") == "1 empty row set aside"
