"""Networks that were read from a file, with facts about their training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsmerge.frozen import asdict, dataclass
from gsmerge.method.networks.weights import NetworkWeights

SCHEMA = 2  # changes with the names of the tensors, and with the tokens that the networks take
SHIPPED = Path(__file__).with_name("shipped.safetensors")
IN_PACKAGE = {"shipped": SHIPPED, "paper": Path(__file__).with_name("paper.safetensors")}  # files of the package


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Networks that were read from a file."""

    networks: NetworkWeights
    path: Path  # the file
    version: str  # version of gsmerge that wrote it
    training: Mapping[str, Any]  # facts about the training, as the trainer wrote them

    def facts(self) -> dict[str, Any]:
        """Return the entries of a report about the checkpoint: name, versions, sizes and training."""
        sizes = {"num_parameters": self.networks.num_parameters, "options": asdict(self.networks.options)}
        name = next((name for name, path in IN_PACKAGE.items() if path == self.path), str(self.path))
        head = {"checkpoint": name, "schema": SCHEMA, "gsmerge": self.version}
        return head | sizes | {"training": dict(self.training)}
