"""Work in parts: calls in order, their records, and engines that cannot be had."""

from __future__ import annotations

import sys

import pytest

from gsmerge.errors import UsageError
from gsmerge.runtime.cluster import Engine
from gsmerge.runtime.record import note, record_run, stage


def halve(number: int) -> float:
    with stage("join"):
        note(f"half of {number}")
    return number / 2


def test_calls_have_records_of_their_own() -> None:
    heard = []
    with record_run(lambda text, *_: heard.append(text)) as run, Engine().start(threads=1, memory=0) as work:
        made = list(work.run("halve", halve, 2, ((number,) for number in (4, 6))))
    assert [value for value, _ in made] == [2, 3]
    assert [record.notes for _, record in made] == [["half of 4"], ["half of 6"]]
    assert all("join" in record.seconds for _, record in made)
    assert run.notes == []
    assert heard[:2] == ["block 1 of 2: halve: join", "block 2 of 2: halve: join"]


def test_calls_are_made_one_by_one() -> None:
    """What they take is made when it is their turn, so that one of them is in memory at once."""
    events = list[str]()

    def calls() -> object:
        for number in (1, 2):
            events.append(f"take {number}")
            yield (number,)

    with Engine().start(threads=1, memory=0) as work:
        for value, _ in work.run("halve", halve, 2, calls()):
            events.append(f"made {value}")
    assert events == ["take 1", "made 0.5", "take 2", "made 1.0"]


@pytest.mark.parametrize(
    ("name", "address", "problem"),
    [("spark", None, "expected one of local, ray"), ("local", "auto", "expected engine ray")],
)
def test_wrong_engines(name: str, address: str | None, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        Engine(name, address)


def test_without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match="Ray is not installed"), Engine("ray").start(threads=1, memory=0):
        pass
