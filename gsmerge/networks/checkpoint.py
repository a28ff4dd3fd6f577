"""Networks in a file: safetensors, so data alone, with what they are and how they were trained in the header."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from gsmerge import __version__
from gsmerge.errors import SceneError
from gsmerge.io.atomic import atomic_output
from gsmerge.networks.modules import Networks
from gsmerge.networks.options import NetworkOptions

SCHEMA = 1  # of the tensors' names and of the tokens that they were trained on
FORMAT = "gsmerge-networks"
REMEDY = "give another file, or --checkpoint none"
SHIPPED = Path(__file__).with_name("shipped.safetensors")


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Networks from a file.

    Args:
        networks: Ready for use, without gradients.
        path: The file.
        version: The gsmerge that wrote it.
        training: Figures of the training, as the trainer wrote them.
    """

    networks: Networks
    path: Path
    version: str
    training: Mapping[str, Any]

    def facts(self) -> dict[str, Any]:
        """What a report says of it."""
        sizes = {"num_parameters": self.networks.num_parameters, "options": asdict(self.networks.options)}
        name = "shipped" if self.path == SHIPPED else str(self.path)
        head = {"checkpoint": name, "schema": SCHEMA, "gsmerge": self.version}
        return head | sizes | {"training": dict(self.training)}


def save_checkpoint(path: str | PathLike[str], networks: Networks, training: Mapping[str, Any]) -> None:
    """Write networks and what is known of their training; an existing file is replaced.

    Raises:
        SceneError: If the file cannot be written.
    """
    header = {"schema": SCHEMA, "gsmerge": __version__, "options": asdict(networks.options), "training": dict(training)}
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in networks.state_dict().items()}
    with atomic_output(path, overwrite=True) as temporary:
        save_file(tensors, temporary, {FORMAT: json.dumps(header)})  # one entry: the order of several is not fixed


def load_checkpoint(path: str | PathLike[str]) -> Checkpoint:
    """Networks of a file; nothing in it is ever executed.

    Raises:
        SceneError: If the file is missing or damaged, of another format or version, or holds other tensors than its
            sizes ask for, or numbers that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(path, "expected a checkpoint, found no such file", REMEDY)
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
    except (SafetensorError, OSError, ValueError) as error:
        told = str(error).splitlines()[0]
        raise SceneError(path, f"expected a safetensors file, could not read it ({told})", REMEDY) from error
    options, training, version = _header(path, header)
    return Checkpoint(build_networks(path, options, tensors), path, version, training)


def build_networks(
    path: Path, options: Mapping[str, Any], tensors: Mapping[str, Tensor], remedy: str = REMEDY
) -> Networks:
    """Networks of some sizes and weights, ready for use.

    Args:
        path: The file that they are from.
        options: Sizes, as ``asdict`` gave them.
        tensors: Weights by name.
        remedy: What to do where they do not fit.

    Raises:
        SceneError: If the sizes are out of range, or the weights others than they ask for.
    """
    try:
        networks = Networks(NetworkOptions.from_dict(options))
    except (ValueError, TypeError) as error:
        words = str(error).splitlines()[0]
        raise SceneError(path, f"expected a header that describes the networks ({words})", remedy) from error
    _check_tensors(path, tensors, networks.state_dict(), remedy)
    networks.load_state_dict(dict(tensors))
    return networks.eval().requires_grad_(False)


def _header(path: Path, header: Mapping[str, str]) -> tuple[dict[str, Any], dict[str, Any], str]:
    """Sizes of the networks, figures of the training, and the version that wrote them."""
    if FORMAT not in header:
        raise SceneError(path, "expected networks of gsmerge, found another safetensors file", REMEDY)
    try:
        told = json.loads(header[FORMAT])
        if not isinstance(told, dict) or told.get("schema") != SCHEMA:
            found = told.get("schema") if isinstance(told, dict) else "none"
            raise SceneError(path, f"expected schema {SCHEMA}, found {found!r}", REMEDY)
        for name, kind in (("options", dict), ("training", dict), ("gsmerge", str)):
            if not isinstance(told.get(name), kind):
                raise ValueError(f"no {name}")
        return told["options"], told["training"], told["gsmerge"]
    except (ValueError, RecursionError) as error:
        words = str(error).splitlines()[0]
        raise SceneError(path, f"expected a header that describes the networks ({words})", REMEDY) from error


def _check_tensors(path: Path, tensors: Mapping[str, Tensor], wanted: Mapping[str, Tensor], remedy: str) -> None:
    """Whether all tensors are there, and what they should be."""
    for name in sorted(tensors.keys() ^ wanted.keys()):
        found = "a tensor too many" if name in tensors else "none"
        raise SceneError(path, f"expected the tensors of its networks, found {found}: {name}", remedy)
    for name, tensor in tensors.items():
        if tensor.shape != wanted[name].shape or tensor.dtype != torch.float32:
            have, want = list(tensor.shape), list(wanted[name].shape)
            raise SceneError(path, f"{name}: expected float32 {want}, found {tensor.dtype} {have}", remedy)
        if not bool(torch.isfinite(tensor).all()):
            raise SceneError(path, f"{name}: expected finite numbers, found others", remedy)


def find_checkpoint(name: str, *, required: bool) -> tuple[Checkpoint | None, list[str]]:
    """The checkpoint that was asked for and what to tell the user; None where the analytic stages work alone.

    Args:
        name: A file, ``"shipped"``: the one in the package, or ``"none"``.
        required: A checkpoint that cannot be used is an error; otherwise it is told, and the stages work without.

    Raises:
        SceneError: If it is required and cannot be used.
    """
    if name == "none":
        return None, []
    try:
        return load_checkpoint(SHIPPED if name == "shipped" else name), []
    except SceneError as error:
        if required:
            raise
        return None, [f"no networks, analytic stages alone: {error}"]
