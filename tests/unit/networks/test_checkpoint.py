from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from network_fixtures import SMALL, noisy, written
from safetensors.torch import load_file, save_file

import gsmerge
from gsmerge.errors import SceneError
from gsmerge.networks.checkpoint import SHIPPED, find_checkpoint, load_checkpoint

Spoil = Callable[[Path], None]


def header(path: Path) -> dict[str, str]:
    size = int.from_bytes(path.read_bytes()[:8], "little")
    return dict(json.loads(path.read_bytes()[8 : 8 + size])["__metadata__"])


def with_text(text: str, name: str = "gsmerge-networks") -> Spoil:
    return lambda path: save_file(load_file(path), path, {name: text})


def with_header(**changes: object) -> Spoil:
    def spoil(path: Path) -> None:
        with_text(json.dumps(json.loads(header(path)["gsmerge-networks"]) | changes))(path)

    return spoil


def with_tensors(change: Callable[[dict[str, torch.Tensor]], object]) -> Spoil:
    def spoil(path: Path) -> None:
        header_text, tensors = header(path), load_file(path)
        change(tensors)
        save_file(tensors, path, header_text)

    return spoil


def cut(share: float) -> Spoil:
    return lambda path: path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)]) and None


NAME = "encoder.latent.weight"
DAMAGED: dict[str, Spoil] = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b"") and None,
    "a few bytes": cut(0.0001),
    "half": cut(0.5),
    "all but the end": cut(0.999),
    "text": lambda path: path.write_text("networks\n") and None,
    "a pickle": lambda path: path.write_bytes(pickle.dumps({"a": 1}) * 9) and None,
    "a huge header": lambda path: path.write_bytes(b"\xff" * 8 + path.read_bytes()[8:]) and None,
    "a torch file": lambda path: torch.save({"a": torch.ones(2)}, path),
    "another program's": with_text("{}", "networks"),
    "no header": lambda path: save_file(load_file(path), path),
    "a header that is no JSON": with_text("{"),
    "a header that is no table": with_text("[1]"),
    "a deep header": with_text("[" * 100_000),
    "another schema": with_header(schema=2),
    "no version": with_header(gsmerge=None),
    "no options": with_header(options=None),
    "unknown options": with_header(options={"depth": 3}),
    "enormous options": with_header(options={"width": 1000000000}),
    "options of another type": with_header(options={"width": "48"}),
    "bounds that bound nothing": with_header(options={"bounds": {"mean": 1e9}}),
    "bounds that are no table": with_header(options={"bounds": 3}),
    "unknown bounds": with_header(options={"bounds": {"far": 1.0}}),
    "other sizes": with_header(options={"width": 64}),
    "training that is no table": with_header(training=3),
    "a tensor too few": with_tensors(lambda t: t.pop(NAME)),
    "a tensor too many": with_tensors(lambda t: t.update(more=torch.ones(1))),
    "another shape": with_tensors(lambda t: t.update({NAME: t[NAME].T.contiguous()})),
    "another type": with_tensors(lambda t: t.update({NAME: t[NAME].double()})),
    "NaN": with_tensors(lambda t: t[NAME].view(-1)[3:4].fill_(float("nan"))),
    "infinity": with_tensors(lambda t: t[NAME].view(-1)[3:4].fill_(float("inf"))),
}


def test_round_trip(tmp_path: Path) -> None:
    networks = noisy()
    checkpoint = load_checkpoint(written(tmp_path / "a.safetensors", networks))
    assert checkpoint.networks.options == SMALL
    assert checkpoint.version == gsmerge.__version__
    assert checkpoint.facts()["training"] == {"steps": 0}
    assert checkpoint.facts()["num_parameters"] == networks.num_parameters
    assert not any(p.requires_grad for p in checkpoint.networks.parameters())
    for name, tensor in networks.state_dict().items():
        assert torch.equal(checkpoint.networks.state_dict()[name], tensor)
    assert os.listdir(tmp_path) == ["a.safetensors"]


def test_the_same_networks_give_the_same_bytes(tmp_path: Path) -> None:
    a, b = (written(tmp_path / name, noisy()).read_bytes() for name in ("a", "b"))
    assert a == b


@pytest.mark.parametrize("damage", DAMAGED)
def test_what_cannot_be_used_is_refused_in_one_line(tmp_path: Path, damage: str) -> None:
    path = written(tmp_path / "a.safetensors", noisy())
    DAMAGED[damage](path)
    with pytest.raises(SceneError, match="expected") as refused:
        load_checkpoint(path)
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith(str(path))
    actual, notes = find_checkpoint(str(path), required=False)
    assert actual is None
    assert len(notes) == 1
    assert str(path) in notes[0]
    with pytest.raises(SceneError):
        find_checkpoint(str(path), required=True)


def test_none_is_nothing() -> None:
    assert find_checkpoint("none", required=False) == (None, [])


def test_what_ships_says_what_it_is() -> None:
    checkpoint, notes = find_checkpoint("shipped", required=True)
    assert checkpoint is not None
    assert notes == []
    assert SHIPPED.stat().st_size < 8e6
    facts = checkpoint.facts()
    assert facts["checkpoint"] == "shipped"  # no path of the machine in a report
    assert {"options", "data", "validation", "step"} <= facts["training"].keys()
    assert "/" not in json.dumps(facts["training"])
