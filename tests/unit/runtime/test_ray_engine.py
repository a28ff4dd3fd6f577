"""Work in parts has calls in order and records, and engines that cannot be had are refused."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from messages import refuses

from gsmerge.errors import UsageError
from gsmerge.runtime.record import note, record_run, stage
from gsmerge.runtime.work import Cluster, Work, start_work


def halve(number: int) -> float:
    with stage("join"):
        note(f"half of {number}")
    return number / 2


def test_calls_have_records_of_their_own() -> None:
    heard = []
    with record_run(lambda text, *_: heard.append(text)) as run, start_work("local", threads=1, memory=0) as work:
        made = list(work.run("halve", halve, 2, ((number,) for number in (4, 6))))
    assert [value for value, _ in made] == [2, 3]
    assert [record.notes for _, record in made] == [["half of 4"], ["half of 6"]]
    assert all("join" in record.seconds for _, record in made)
    assert run.notes == []
    assert heard[:2] == ["block 1 of 2: halve: join", "block 2 of 2: halve: join"]


def test_engine_ray_without_the_package_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with refuses(UsageError, "engine ray", "ray>=2.9,<3"), start_work("ray", threads=1, memory=0):
        pass


class Ref:
    """A result, or the error in its place."""

    def __init__(self, value: Any) -> None:
        self.value = value


class FakeRay:
    """In place of Ray: calls are made when they are submitted, and end in the order of submission."""

    class exceptions:  # noqa: N801  # a module of Ray's
        class RayError(Exception):
            pass

        class RayTaskError(RayError):
            cause: object = None

    def __init__(self, nodes: list[dict[str, float]]) -> None:
        self.given, self.running, self.most, self.options = nodes, 0, 0, list[dict[str, Any]]()

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": node} for node in self.given]

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": sum(node.get("CPU", 0) for node in self.given)}

    def remote(self, **options: Any) -> Any:
        def decorate(function: Callable[..., Any]) -> Any:
            def submit(*arguments: Any) -> Ref:
                self.running += 1
                self.most = max(self.most, self.running)
                try:
                    return Ref(function(*arguments))
                except ZeroDivisionError as error:
                    failed = self.exceptions.RayTaskError("traceback")
                    failed.cause = error
                    return Ref(failed)
                except KeyError:
                    return Ref(self.exceptions.RayError("worker died"))

            def with_needs(**needs: Any) -> Any:
                self.options.append(options | needs)
                return SimpleNamespace(remote=submit)

            return SimpleNamespace(options=with_needs)

        return decorate

    def wait(self, refs: list[Any], num_returns: int, timeout: float | None) -> tuple[list[Any], list[Any]]:
        if timeout == 0:
            return [], refs
        self.running -= num_returns
        return refs[:num_returns], refs[num_returns:]

    def get(self, ref: Ref) -> Any:
        if isinstance(ref.value, Exception):
            raise ref.value
        return ref.value


def work_of(nodes: list[dict[str, float]], threads: int | None = None, memory: int = 8) -> tuple[Work, FakeRay]:
    cluster, ray = Cluster.__new__(Cluster), FakeRay(nodes)
    cluster.ray = ray  # type: ignore[assignment]
    return Work(cluster, threads, memory), ray


TWO = [{"CPU": 1.0, "memory": 100.0}, {"CPU": 2.0, "memory": 100.0}]


def test_a_cluster_has_as_many_calls_at_once_as_processors() -> None:
    work, ray = work_of(TWO)
    made = list(work.run("halve", halve, 7, ((number,) for number in range(7))))
    assert [value for value, _ in made] == [number / 2 for number in range(7)]
    assert [record.notes for _, record in made] == [[f"half of {number}"] for number in range(7)]
    assert ray.most == 3
    assert ray.options[0]["num_cpus"] == 1


def test_error_of_a_call_ends_the_work_at_once() -> None:
    taken = []

    def calls() -> Iterator[tuple[int]]:
        for number in range(9):
            taken.append(number)
            yield (number - 1,)

    work, _ = work_of(TWO)
    with pytest.raises(ZeroDivisionError):
        list(work.run("divide", lambda number: 1 / number, 9, calls()))
    assert len(taken) < 9


def test_lost_processes_are_one_line() -> None:
    work, _ = work_of(TWO)
    with refuses(UsageError, "engine ray: find", 6, "worker died"):
        list(work.run("find", lambda key: {}[key], 1, [("a",)]))


def test_a_task_asks_for_what_one_node_has() -> None:
    nodes = [{"CPU": 64.0, "memory": 16.0}, {"CPU": 8.0, "memory": 512.0}, {"memory": 900.0}]
    work, _ = work_of(nodes)
    assert work.cluster.needs(32, 100) == {"num_cpus": 8.0, "memory": 100}
    assert work.cluster.needs(32, 10) == {"num_cpus": 32, "memory": 10}
    assert work.cluster.needs(2, 10_000) == {"num_cpus": 2, "memory": 512}
    empty, _ = work_of([{"memory": 9.0}])
    with refuses(UsageError, "engine ray", "processors", "none"):
        empty.cluster.needs(1, 1)


def test_arguments_of_a_call_are_gone_before_those_of_the_next_one_are_made() -> None:
    class Piece:
        pass

    last: list[weakref.ref[Piece]] = []

    def make_piece() -> Piece:
        assert [ref() for ref in last] == [None] * len(last)
        piece = Piece()
        last.append(weakref.ref(piece))
        return piece

    with start_work("local", threads=1, memory=0) as work:
        outcomes = list(work.run("make", id, 3, ((make_piece(),) for _ in range(3))))
    assert len(outcomes) == len(last) == 3
