"""Pickles: what a pickler writes of plain values is read, all else is refused, within the budget."""

from __future__ import annotations

import pickle
import random
import tracemalloc
from collections.abc import Callable
from itertools import count
from typing import Any

import pytest
from messages import refuses

from gsmerge.errors import SceneError
from gsmerge.io import bounds, pickles
from gsmerge.io.bounds import ReadBudget
from gsmerge.io.pickles import StandIn, read_pickle

SHARED: list[Any] = [1, "a"]
PLAIN = {
    "numbers": [0, 255, 256, 65535, 65536, -1, 2**31 - 1, -(2**31), 2**31, -(2**100), 2**2000, 1.5, float("inf")],
    "others": (None, True, False, "", "ä€😀\n", "a" * 300, (), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)),
    "shared": [SHARED, {"b": SHARED}, SHARED],
    "many": [list(range(3000)), {number: str(number) for number in range(-5, 3000)}, [], {}],
    7: {"": {}},
}
BUDGET = ReadBudget("a", 1000)


class Point(StandIn):
    state: object = None

    def set_state(self, state: object) -> None:
        self.state = state


NAMES = {("a", "Point"): Point, ("a", "plain"): 5}


@pytest.mark.parametrize("dumps", [pickle.dumps, pickle._dumps])  # type: ignore[attr-defined]
@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_plain_values_are_what_was_written(dumps: Callable[..., bytes], protocol: int) -> None:
    actual = read_pickle(dumps(PLAIN, protocol), BUDGET, {})
    assert actual == PLAIN
    assert actual["shared"][0] is actual["shared"][2]
    for size in (3, 300) if protocol > 2 else ():
        assert read_pickle(dumps(bytes(size), protocol), BUDGET, {}) == bytes(size)


def test_names_storages_and_states() -> None:
    content = b"\x80\x02(ca\nPoint\n)Rq\0K\1bh\0ca\nplain\nX\1\0\0\0xQt."
    point, same, plain, storage = read_pickle(content, BUDGET, NAMES, lambda pid: [pid])
    assert (point.state, plain, storage) == (1, 5, ["x"])
    assert point is same
    with refuses(ValueError, "", "data"):
        read_pickle(content, BUDGET, NAMES)


def test_other_instructions_are_refused_unread() -> None:
    codes = set(range(256)) - pickles._INSTRUCTIONS.keys()
    assert len(codes) == 219
    for code in codes:
        with refuses(ValueError, "", "instruction"):
            read_pickle(b"\x80\x02" + bytes([code]), BUDGET, {})


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"cos\nmkdir\n.", "os.mkdir"),
        (b"ca\nb", "load"),
        (b"K\1)R.", "callable"),
        (b"ca\nPoint\nK\1R.", "argument"),
        (b"ca\nPoint\nK\1\x85R.", "arguments"),
        (b"]Nb.", "state"),
        (b"K\1K\1a.", "append"),
        (b"ca\nPoint\n}b.", "state"),
        (b"](K\1K\2u.", "dictionary"),
        (b"}(K\1u.", "zip"),
        (b"}(K\1Ne.", "append"),
        (b"}NNs.", "keys"),
        (b"}G\0\0\0\0\0\0\0\0Ns.", "keys"),
        (b"}J\0\0\0\x80Ns.", "keys"),
        (b"}K\1NsK\1Ns.", "again"),
        (b"h\0.", "values"),
        (b"s.", "values"),
        (b"t.", "values"),
        (b"N(Na.", "values"),
        (b"N", "end"),
        (b"C\5abc.", "end"),
        (b"M\1", "2 bytes"),
        (b"X\1\0\0\0\xff.", "utf-8"),
        (b"](N.", "one"),
    ],
)
def test_what_no_pickler_writes_is_refused(content: bytes, found: str) -> None:
    with refuses(ValueError, "", found):
        read_pickle(content, BUDGET, NAMES)


def test_a_memo_takes_no_more_room_than_its_values() -> None:
    assert read_pickle(b"]r\xff\xff\xff\xff.", BUDGET, {}) == []


def test_damage_ends_in_a_value_or_in_a_refusal() -> None:
    content = pickle.dumps(PLAIN | {"many": []}, 2)
    for length in range(len(content)):
        with refuses(ValueError, ""):
            read_pickle(content[:length], BUDGET, {})
    draw, refused = random.Random(0), count()
    for _ in range(1500):
        spoilt = bytearray(content)
        for _ in range(draw.randint(1, 3)):
            spoilt[draw.randrange(len(spoilt))] = draw.randrange(256)
        try:
            read_pickle(bytes(spoilt), BUDGET, NAMES)
        except ValueError:
            next(refused)
    assert 300 < next(refused) < 1500


def test_steps_are_as_many_as_the_bytes_allow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounds, "_FREE_STEPS", 1000)
    with refuses(SceneError, "a", "1,100", "steps"):
        read_pickle(b"\x80\x02" + b"]" * 1200, BUDGET, {})


@pytest.mark.slow
@pytest.mark.parametrize("unit", [b"]", b"}K\1Ns", b"}", b"(", b"\x8c\3\xe2\x82\xac"])
def test_structures_stay_within_the_budget(unit: bytes) -> None:
    num_bytes = 200_000
    tracemalloc.start()
    with refuses(SceneError, "a", "270,000", "steps"):
        read_pickle(b"\x80\x02" + unit * 270_000, ReadBudget("a", num_bytes), {})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64e6 + 20 * num_bytes
