"""Read and write networks as a safetensors file, which holds no code.

The header has the sizes of the networks and facts about their training.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from gsmerge.errors import SceneError
from gsmerge.frozen import asdict
from gsmerge.io.atomic import atomic_output
from gsmerge.io.bounds import ReadBudget, parse_json, read_budget
from gsmerge.io.tensor_file import read_tensors
from gsmerge.method.networks.checkpoint import IN_PACKAGE, SCHEMA, Checkpoint
from gsmerge.method.networks.options import NetworkOptions, weight_shapes
from gsmerge.method.networks.weights import NetworkWeights
from gsmerge.types import StrPath
from gsmerge.version import __version__

FORMAT = "gsmerge-networks"
REMEDY = "give another file, or --set checkpoint=none"


def save_checkpoint(path: str | PathLike[str], networks: NetworkWeights, training: Mapping[str, Any]) -> None:
    """Write networks and facts about their training to a file, which may exist. Raises SceneError if that fails."""
    header = {"schema": SCHEMA, "gsmerge": __version__, "options": asdict(networks.options), "training": dict(training)}
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_bytes(
            save(dict(networks.arrays), {FORMAT: json.dumps(header)})
        )  # a single entry, since several entries would have no fixed order


def load_checkpoint(path: str | PathLike[str]) -> Checkpoint:
    """Read networks from a file, without executing anything in it.

    Raises:
        SceneError: If the file is missing, damaged or of another format or version, or if its tensors are not finite or
            do not have the sizes in its header.
    """
    path = Path(path)
    if not path.is_file():
        raise SceneError(path, "expected a checkpoint, found no such file", REMEDY)
    budget = read_budget(path)
    header, tensors = read_tensors(path, "a safetensors file", REMEDY)
    options, training, version = _read_header(header, budget)
    return Checkpoint(build_networks(path, options, tensors), path, version, training)


def build_networks(path: Path, options: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> NetworkWeights:
    """Make networks from their options, see :meth:`NetworkOptions.from_dict`, and their weights by name.

    Raises SceneError about the file ``path`` if an option is out of range, or if the weights do not fit the options.
    """
    try:
        sizes = NetworkOptions.from_dict(options)
    except (ValueError, TypeError) as error:
        raise _header_error(path, error) from error
    expected = weight_shapes(sizes)
    for name in sorted(arrays.keys() ^ expected.keys()):
        difference = "a tensor too many" if name in arrays else "none"
        raise SceneError(path, f"expected the tensors of its networks, found {difference}: {name}", REMEDY)
    for name, array in arrays.items():
        if array.shape != expected[name] or array.dtype != np.float32:
            have = list(array.shape)
            want = list(expected[name])
            raise SceneError(path, f"{name}: expected float32 {want}, found {array.dtype} {have}", REMEDY)
        if not np.isfinite(array).all():
            raise SceneError(path, f"{name}: expected finite numbers, found NaN or infinity", REMEDY)
    return NetworkWeights(sizes, {name: np.ascontiguousarray(array) for name, array in arrays.items()})


def _read_header(header: Mapping[str, str], budget: ReadBudget) -> tuple[dict[str, Any], dict[str, Any], str]:
    """Return the options of the networks, facts about the training, and the version that wrote the file."""
    path = budget.path
    if FORMAT not in header:
        raise SceneError(path, "expected networks of gsmerge, found another safetensors file", REMEDY)
    try:
        values = parse_json(header[FORMAT], budget)
        if not isinstance(values, dict) or values.get("schema") != SCHEMA:
            schema = values.get("schema") if isinstance(values, dict) else "none"
            raise SceneError(path, f"expected schema {SCHEMA}, found {schema!r}", REMEDY)
        for name, kind in (("options", dict), ("training", dict), ("gsmerge", str)):
            if not isinstance(values.get(name), kind):
                raise ValueError(f"no {name}")
        return values["options"], values["training"], values["gsmerge"]
    except ValueError as error:
        raise _header_error(path, error) from error


def _header_error(path: StrPath, error: Exception) -> SceneError:
    """Return the error to raise for a file whose header does not describe networks, for the reason in ``error``."""
    reason = str(error).splitlines()[0]
    return SceneError(path, f"expected a header that describes the networks ({reason})", REMEDY)


def find_checkpoint(name: str, *, required: bool) -> tuple[Checkpoint | None, list[str]]:
    """Load a checkpoint by name, and return it with notes for the user.

    ``name`` is a file, or ``"shipped"`` or ``"paper"`` for one in the package. For ``"none"``, None is returned, and
    the stages run without networks. If a checkpoint of the package cannot be used and is not ``required``, None is
    returned with a note. Any other checkpoint that cannot be used raises SceneError.
    """
    if name == "none":
        return None, []
    try:
        return load_checkpoint(IN_PACKAGE.get(name, name)), []
    except SceneError as error:
        if required or name not in IN_PACKAGE:
            raise
        return None, [f"no networks, only the analytic stages: {error}"]
