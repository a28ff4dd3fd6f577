"""Training on captures, whose Gaussians a backbone predicts for every subset of views that is drawn."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from threading import Lock

import numpy as np
import pytest
from messages import refuses
from re10k_chunks import entry, save, torch
from scenes import arc, make_scene, room
from tiny_scene import Tiny
from training_runs import PAPER, written

from gsmerge.errors import SceneError
from gsmerge.facts.views import subset
from gsmerge.research.captures import Capture, list_captures
from gsmerge.research.training import make_example, make_training_scene, train
from gsmerge.research.training.backbones import NOVEL_PHOTOS, PredictedCapture, bind_backbone
from gsmerge.research.training.examples import draw_views
from gsmerge.types import Cameras, Gaussians, Scene

pytestmark = pytest.mark.usefixtures("one_thread")

VIEWS = 8
RUN = replace(PAPER, steps=2, save_every=1, buffer=1, refresh=1, workers=2)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(room(), arc(VIEWS, 32, 24))


@pytest.fixture(scope="module")
def data(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene's cameras and photos as RE10K has them. Read only."""
    folder, cameras = tmp_path_factory.mktemp("re10k"), scene.cameras
    photos = (scene.images * 255).round().astype(np.uint8)
    c2w = np.linalg.inv(cameras.viewmats)
    save(folder, entry(Tiny(c2w, cameras.Ks[0], 32, 24, photos, scene.gaussians, scene.names), "room"))
    (folder / "index.json").write_text(json.dumps({"room": "000000.torch"}))
    return folder


class Guess:
    """A backbone that knows the scene, and remembers which views it was given.

    Its depths are too large, the more so the fewer views it gets.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.calls, self.busy = scene, list[tuple[int, ...]](), Lock()

    def __call__(self, images: np.ndarray, cameras: Cameras) -> Gaussians:
        assert not torch.is_grad_enabled()
        assert self.busy.acquire(blocking=False), "called by two threads at once"
        try:
            return self.guess(images, cameras)
        finally:
            self.busy.release()

    def guess(self, images: np.ndarray, cameras: Cameras) -> Gaussians:
        distances = np.abs(cameras.viewmats[:, None] - self.scene.cameras.viewmats).max((2, 3))
        ids = distances.argmin(1).tolist()
        assert distances.min(1).max() < 1e-5
        assert np.abs(images - self.scene.images[ids]).mean() < 0.05
        self.calls.append(tuple(ids))
        gaussians, centres = subset(self.scene, ids).gaussians, cameras.centres.repeat(32 * 24, 0)
        rays = gaussians.means - centres
        return replace(gaussians, means=centres + (1 + 0.2 / len(ids)) * rays).to("cpu")


def files(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(out.iterdir())}


@pytest.mark.slow
def test_every_draw_is_predicted_from_its_own_views(scene: Scene, data: Path) -> None:
    guess, rng = Guess(scene), np.random.default_rng(0)
    (capture,) = bind_backbone(list_captures(data), guess)
    for draw in range(8):
        example = capture.draw(PAPER, rng)
        ids = guess.calls[draw]
        count = len(ids)
        assert (example.name, len(example.cameras), list(ids)) == ("room", count, sorted(set(ids)))
        assert len(example.photos) == min(VIEWS, count + NOVEL_PHOTOS)
        assert draw_views(example, PAPER, rng) is example  # a subset of it would keep its depths
        if count == 1:
            continue
        ours, theirs = example.cameras, scene.cameras[list(ids)]
        scale = np.linalg.norm(np.ptp(ours.centres, 0)) / np.linalg.norm(np.ptp(theirs.centres, 0))
        depths = np.linalg.norm(example.members.means[: 32 * 24] - ours.centres[0], axis=1) / scale
        expected = np.linalg.norm(subset(scene, ids[:1]).gaussians.means - theirs.centres[0], axis=1)
        np.testing.assert_allclose(depths / expected, 1 + 0.2 / count, rtol=1e-3)
    assert len(set(guess.calls)) > 5
    assert {len(ids) for ids in guess.calls} > {1, 8}


def test_without_random_views_subsets_are_spread(scene: Scene, data: Path) -> None:
    guess, rng = Guess(scene), np.random.default_rng(0)
    (capture,) = bind_backbone(list_captures(data), guess)
    options = replace(PAPER, random_views=(), views=(2, 3), photo_side=16)
    sizes = {capture.draw(replace(options, photo_side=0), rng).images.shape[1:3] for _ in range(8)}
    assert set(guess.calls) == {(0, 7), (0, 4, 7)}
    assert sizes == {(12, 16)}  # photo_scale

    def small(images: np.ndarray, cameras: Cameras) -> Gaussians:
        assert images.shape[1:] == (12, 16, 3)
        assert (cameras.width, cameras.height) == (16, 12)
        return make_scene(room(), replace(cameras, Ks=cameras.Ks.round(3))).gaussians

    assert PredictedCapture(capture.capture, small).draw(options, rng).images.shape[1:3] == (12, 16)


def test_pixels_may_lack_a_gaussian(scene: Scene, data: Path) -> None:
    guess = Guess(scene)

    def with_holes(images: np.ndarray, cameras: Cameras) -> Gaussians:
        means = guess(images, cameras).means.numpy().copy()
        means[::7] = np.nan
        return replace(guess(images, cameras).numpy(), means=means)

    (capture,) = bind_backbone(list_captures(data), with_holes)
    example = capture.draw(PAPER, np.random.default_rng(0))
    assert not (example.members.pixels % 7 == 0).any()
    assert np.isfinite(example.base.means).all()


@pytest.fixture(scope="module")
def run(scene: Scene, data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Guess, Path]:
    """A run, and what it asked of the backbone. Read only."""
    out, guess = tmp_path_factory.mktemp("run"), Guess(scene)
    done = train(list_captures(data), [], out, RUN, backbone=guess, threads=1)
    assert done.step == 2
    return guess, out


@pytest.mark.slow
def test_training_asks_for_many_subsets(run: tuple[Guess, Path]) -> None:
    guess, out = run
    assert len(set(guess.calls)) >= RUN.steps * RUN.crops
    assert {"best.safetensors", "losses.csv", "validation-room.png"} < set(files(out))
    assert len((out / "losses.csv").read_text().splitlines()) == 3


@pytest.mark.slow
def test_a_run_is_repeated_and_resumed_to_the_bit(
    scene: Scene, data: Path, run: tuple[Guess, Path], tmp_path: Path
) -> None:
    """On any number of threads, those that read ahead among them."""
    expected, captures, guess = files(run[1]), list_captures(data), Guess(scene)

    def stop(step: int, *_: float) -> None:
        if step == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(captures, [], tmp_path / "run", RUN, backbone=guess, threads=2, progress=stop)
    assert train(captures, [], tmp_path / "run", RUN, backbone=guess, threads=2).resumed == 1
    assert files(tmp_path / "run") == expected
    other = replace(captures[0], name="hall")
    with refuses(SceneError, "state.safetensors", "data"):
        train([other], [], tmp_path / "run", RUN, backbone=guess, threads=1)


@pytest.mark.slow
def test_captures_and_shards_together(scene: Scene, data: Path, tmp_path: Path) -> None:
    example = make_example(make_training_scene(scene, range(3)), PAPER, 0.1, "shard")
    guess = Guess(scene)
    both = [*list_captures(data), written(example, tmp_path)]
    train(both[::-1], both, tmp_path / "run", RUN, backbone=guess, threads=1)
    assert {"validation-room.png", "validation-shard.png"} < set(files(tmp_path / "run"))


def test_what_cannot_be_trained_on_is_refused(scene: Scene, data: Path, tmp_path: Path) -> None:
    """The first that trains here pays for what torch loads late."""
    captures = list_captures(data)
    with refuses(ValueError, "backbone", "room"):
        train(captures, [], tmp_path, RUN)
    with refuses(ValueError, "backbone", "room", 10):
        train(captures, [], tmp_path, RUN, backbone=lambda *_: scene.gaussians[:10])

    def logits(images: np.ndarray, cameras: Cameras) -> Gaussians:
        gaussians = Guess(scene)(images, cameras).numpy()
        return replace(gaussians, opacities=8 * gaussians.opacities)

    with refuses(SceneError, "opacities", "logits"):
        train(captures, [], tmp_path, RUN, backbone=logits)
    missing = Capture("hall", tmp_path / "none.torch", tmp_path / "none.torch")
    with refuses(SceneError, "none.torch", "no such file"):
        train([missing], [], tmp_path, RUN, backbone=Guess(scene))


@pytest.mark.slow
def test_the_guide_s_example_runs(scene: Scene, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[4] / "docs" / "internals" / "training.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (tmp_path / "re10k").mkdir()
    (tmp_path / "re10k" / "train").symlink_to(data)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gsmerge.research.training.preset_options", lambda _: RUN)
    guess = Guess(scene)
    exec(compile(example, "training.md", "exec"), {"model": guess})
    assert len(guess.calls) >= RUN.steps
    assert (tmp_path / "run" / "best.safetensors").is_file()
