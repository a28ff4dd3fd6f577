"""Who does the fit and the scores: the CPU or a GPU."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec

import pytest
import torch
from gpu_runs import gpu
from messages import refuses

from gsmerge import CompactOptions, Scene, compact
from gsmerge.fit import ON_CPU
from gsmerge.fit import gpu as package
from gsmerge.fit.gpu import MIN_PIXELS, choose_backend, self_check
from gsmerge.raster import cuda

QUICK = {"fit_steps": 8, "superpixels": "20%", "checkpoint": "none"}


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    package.cuda_problem.cache_clear()
    yield
    package.cuda_problem.cache_clear()


@pytest.fixture
def checks(monkeypatch: pytest.MonkeyPatch) -> list[str | None]:
    """A CUDA device and gsplat; gives what the self-checks of these tests say, the next one last."""
    results: list[str | None] = []
    monkeypatch.setattr(package, "has_driver", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "gsplat_problem", lambda: None)
    monkeypatch.setattr(self_check, "find_difference", lambda device: results.pop())
    return results


def test_cuda_is_taken_where_it_pays(checks: list[str | None]) -> None:
    checks.append(None)
    chosen = [choose_backend(*given) for given in (("cpu", 10**9), ("auto", MIN_PIXELS - 1))]
    assert chosen == [(ON_CPU, None)] * 2
    assert checks == [None]  # nothing is loaded or checked for those
    for given in (("auto", MIN_PIXELS), ("cuda", 1)):
        backend, note = choose_backend(*given)
        assert (backend.device, note) == ("cuda", None)


def test_self_check_is_made_once_in_a_process(checks: list[str | None]) -> None:
    checks.append("the image differed")
    notes = [choose_backend("cuda", 1)[1] for _ in range(3)]
    assert notes == ["the fit and the scores run on the CPU, not on a GPU: the image differed"] * 3


@pytest.mark.parametrize("device", ["cuda", "auto"])
def test_gsplat_that_cannot_be_used_is_noted(
    device: str, checks: list[str | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cuda, "gsplat_problem", lambda: "gsplat has no compiled part")
    backend, note = choose_backend(device, MIN_PIXELS)
    assert backend is ON_CPU
    assert note == "the fit and the scores run on the CPU, not on a GPU: gsplat has no compiled part"


def test_computer_without_cuda_is_noted_only_where_cuda_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for driver in (False, True):
        monkeypatch.setattr(package, "has_driver", lambda driver=driver: driver)
        assert choose_backend("auto", MIN_PIXELS) == (ON_CPU, None)
    note = "the fit and the scores run on the CPU, not on a GPU: torch finds no CUDA device"
    assert choose_backend("cuda", MIN_PIXELS) == (ON_CPU, note)


def test_options_only_name_a_device() -> None:
    """Whether there is one is asked when it is used."""
    assert [CompactOptions(device=name).device for name in ("cpu", "cuda", "auto")] == ["cpu", "cuda", "auto"]
    with refuses(ValueError, "device", "gpu"):
        CompactOptions(device="gpu")


def test_compact_runs_on_the_cpu_and_says_why(scene: Scene, checks: list[str | None]) -> None:
    checks.append("the image differed")
    actual, expected = (compact(scene, device=device, **QUICK) for device in ("cuda", "cpu"))
    note = "the fit and the scores run on the CPU, not on a GPU: the image differed"
    assert actual.report.notes == [note, *expected.report.notes]
    assert actual.report.options == expected.report.options
    assert actual.report.psnr_after == expected.report.psnr_after
    assert actual.report.choices["fit"]["device"] == "cpu"


@gpu
def test_gpu_passes_its_check(scene: Scene) -> None:
    assert find_spec("gsplat") is not None
    assert package.cuda_problem() is None
    result = compact(scene, device="cuda", **QUICK)
    assert result.report.choices["fit"]["device"] == result.report.options["device"] == "cuda"
