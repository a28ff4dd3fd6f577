"""Settings and hints are given by name with ``--set`` and ``--hint``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from messages import refuse_all, refuses

from gsmerge.cli.parameters import OPTIONS, Args, parse_pairs
from gsmerge.errors import UsageError
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.setting import flat_settings

KNOWN = flat_settings(EvaluateOptions) | flat_settings(CompactOptions)


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
    assert parse_pairs("--set", [pair], KNOWN) == expected


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
        parse_pairs("--set", pairs, KNOWN)


def test_settings_come_from_options_and_set_together() -> None:
    args = Args(k=2, effort="fast", set=["overlap=0.5"])
    settings = args.settings()
    assert (settings.decode.k, settings.effort, settings.match.overlap) == (2, "fast", 0.5)
    refuse_all(UsageError, [
        (Args(k=2, set=["k=3"]).settings, "--set k", "--k"), (Args(set=["iou=2"]).settings, "--set iou", "0 to 1", 2),
        (lambda: Args(set=["fit=full"]).settings(fit="none"), "--set fit", "unknown", "--set help"),
    ])  # fmt: skip


def test_words_of_options_become_values() -> None:
    """A budget stays a text: batches compare it with that of finished results."""
    words = {"budget": "300", "k": "2", "seed": "3", "effort": "fast", "cameras": "none", "images": "a/b"}
    values = {name: OPTIONS[name].read(word, ()) for name, word in words.items()}
    assert values == {"budget": "300", "k": 2, "seed": 3, "effort": "fast", "cameras": "none", "images": Path("a/b")}


def test_set_fills_several_kinds_of_settings() -> None:
    assert Args(set=["k=2", "max_views=3"]).values(CompactOptions, ExtendOptions) == {"k": 2, "max_views": 3}
    made, online = Args(set=["recipe=paper", "max_views=3"]).make(CompactOptions, ExtendOptions)
    assert (made.segment.segmentation, online.max_views) == ("bass-st", 3)


def test_the_seed_may_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMERGE_SEED", "7")
    assert Args().settings().seed == 7
    assert Args(seed=3).settings().seed == Args(set=["seed=3"]).settings().seed == 3
    monkeypatch.setenv("GSMERGE_SEED", "many")
    with refuses(UsageError, "GSMERGE_SEED", "'many'"):
        Args().settings()


def test_an_unknown_setting_is_refused_with_a_near_name() -> None:
    with refuses(UsageError, "--set superpixel", "superpixels"):
        parse_pairs("--set", ["superpixel=3"], KNOWN)
    with refuses(UsageError, "--set foo", "unknown; --set help"):
        parse_pairs("--set", ["foo=1"], flat_settings(CompactOptions))
