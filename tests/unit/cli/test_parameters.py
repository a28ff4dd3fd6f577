"""Settings and hints are given by name with ``--set`` and ``--hint``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from messages import refuse_all, refuses

from gsmerge.cli.parameters import Given, path_or_none, read_settings
from gsmerge.errors import UsageError
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.settings.extend import ExtendOptions

KINDS, COMPACT = (EvaluateOptions, CompactOptions), (CompactOptions,)


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ("k=2", {"k": 2}),
        ("k=mixed", {"k": "mixed"}),
        ("superpixels=4.4%", {"superpixels": "4.4%"}),
        ("poses=fixed", {"poses": "fixed"}),
        ("require_checkpoint=true", {"require_checkpoint": True}),
        ("require-checkpoint=false", {"require_checkpoint": False}),
        ("overlap=1", {"overlap": 1}),
        ("quality=30dB", {"quality": "30dB"}),
        ("quality=null", {"quality": None}),
        ("checkpoint=7", {"checkpoint": "7"}),  # the name of a file
        ("checkpoint=a=b", {"checkpoint": "a=b"}),
        ("crop=", {"crop": ""}),
        ("photo_scale=2.5", {"photo_scale": 2.5}),
        ("overlap=.5", {"overlap": 0.5}),
        ("lpips=alex", {"lpips": ["alex"]}),
    ],
)
def test_values_of_set_are_read_as_json_or_text(pair: str, expected: dict[str, Any]) -> None:
    assert read_settings(KINDS, [pair]).values == expected


@pytest.mark.parametrize(
    ("pairs", "place", "found"),
    [
        (["k"], "--set", ["NAME=VALUE", "'k'"]), (["=2"], "--set ", ["unknown"]),
        (["pose=free"], "--set pose", ["unknown", "poses", "--set help"]),
        (["k=1", "k=2"], "--set k", ["twice"]), (["require_checkpoint=1"], "--set require_checkpoint", ["'1'"]),
        (["neighbors=true"], "--set neighbors", ["'true'"]), (["neighbors=2.5"], "--set neighbors", ["'2.5'"]),
        (["match=all"], "--set match", ["overlap", "'all'"]), (["k=" + "[" * 100_000], "--set k", ["[["]),
    ],
)  # fmt: skip
def test_impossible_pairs_of_set_are_refused(pairs: list[str], place: str, found: list[str]) -> None:
    with refuses(UsageError, place, *found):
        read_settings(KINDS, pairs).make(*KINDS)


def test_settings_come_from_options_and_set_together() -> None:
    (settings,) = read_settings(COMPACT, ["overlap=0.5"], k="2", effort="fast", fit=None).make(*COMPACT)
    assert (settings.decode.k, settings.effort, settings.match.overlap) == (2, "fast", 0.5)
    refuse_all(UsageError, [
        (lambda: read_settings(COMPACT, ["k=3"], k="2"), "--set k", "--k"),
        (lambda: read_settings(COMPACT, ["iou=2"]).make(*COMPACT), "--set iou", "0 to 1", 2),
        (lambda: read_settings(COMPACT, k="9").make(*COMPACT), "--k", "1 to 8", 9),
    ])  # fmt: skip


def test_texts_of_options_become_values() -> None:
    """A budget stays a text: batches compare it with that of finished results."""
    texts = {"budget": "300", "k": "2", "seed": "3", "effort": "fast"}
    assert read_settings(COMPACT, **texts).values == {"budget": "300", "k": 2, "seed": 3, "effort": "fast"}
    assert (path_or_none("none"), path_or_none("./none"), path_or_none(None)) == ("none", Path("none"), None)


def test_set_fills_several_kinds_of_settings() -> None:
    kinds = (CompactOptions, ExtendOptions)
    given = read_settings(kinds, ["recipe=paper", "max_views=3"])
    assert given.values == {"recipe": "paper", "max_views": 3}
    made, online = given.make(*kinds)
    assert (made.segment.segmentation, online.max_views) == ("bass-st", 3)


def test_the_seed_may_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    def seed_of(given: Given) -> int:
        return int(given.make(*COMPACT)[0].seed)

    monkeypatch.setenv("GSMERGE_SEED", "7")
    assert seed_of(read_settings(COMPACT)) == 7
    assert seed_of(read_settings(COMPACT, seed="3")) == seed_of(read_settings(COMPACT, ["seed=3"])) == 3
    monkeypatch.setenv("GSMERGE_SEED", "many")
    with refuses(UsageError, "GSMERGE_SEED", "'many'"):
        seed_of(read_settings(COMPACT))


def test_an_unknown_setting_is_refused_with_a_near_name() -> None:
    with refuses(UsageError, "--set superpixel", "superpixels"):
        read_settings(KINDS, ["superpixel=3"])
    with refuses(UsageError, "--set foo", "unknown; --set help"):
        read_settings(COMPACT, ["foo=1"])
