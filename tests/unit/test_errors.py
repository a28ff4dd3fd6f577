"""Errors, in processes of a cluster."""

from __future__ import annotations

import pickle

import pytest

from gsmerge.errors import OUT_OF_MEMORY, BatchError, GsmergeError, SceneError, TargetError, UsageError


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


def test_advice_for_all_commands_names_no_option() -> None:
    assert "--" not in OUT_OF_MEMORY


def test_views_without_names_are_named_once() -> None:
    assert str(SceneError("a.json", "view view 0: expected numbers")) == "a.json: view 0: expected numbers"
