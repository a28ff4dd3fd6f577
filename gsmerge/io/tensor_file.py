"""Read safetensors files into memory. Files are not mapped, since a mapped file that shrinks ends the process."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from safetensors import SafetensorError, deserialize

from gsmerge.errors import SceneError
from gsmerge.io.bounds import parse_json, read_budget

_NUMPY_TYPES = {  # names of types in the file -> NumPy's types
    "F64": np.float64, "F32": np.float32, "F16": np.float16, "I64": np.int64, "I32": np.int32, "I16": np.int16,
    "I8": np.int8, "U64": np.uint64, "U32": np.uint32, "U16": np.uint16, "U8": np.uint8, "BOOL": np.bool_,
}  # fmt: skip


def read_tensors(
    path: Path, what: str, remedy: str, *, arrays: bool = True
) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Read the metadata of a safetensors file, and its arrays by name unless ``arrays`` is False.

    Raise SceneError if the file is no safetensors file, or becomes shorter while it is read. The error says that
    ``what`` was expected, and has the ``remedy``.
    """
    budget = read_budget(path)
    try:
        with path.open("rb") as file:
            header_size = 8  # bytes of the number at the start, which is the length of the header
            length_bytes = file.read(header_size)
            length = int.from_bytes(length_bytes, "little")
            if not 0 < length <= budget.file_bytes:
                raise ValueError("no header of a safetensors file")
            header_bytes = file.read(length)
            # memory for the description of an array; copies of the file in memory
            description_bytes = 1800
            copies = 3
            budget.check_memory(description_bytes * header_bytes.count(b"{") + copies * budget.file_bytes, "arrays")
            header = parse_json(header_bytes.decode("utf-8"), budget)
            metadata = (header.get("__metadata__") if isinstance(header, dict) else None) or {}
            if not isinstance(metadata, dict) or not all(isinstance(text, str) for text in metadata.values()):
                raise ValueError("metadata that is not text")
            del header  # before the arrays need the memory
            tensors = {
                name: np.frombuffer(tensor["data"], _NUMPY_TYPES[tensor["dtype"]]).reshape(tensor["shape"])
                for name, tensor in (deserialize(length_bytes + header_bytes + file.read()) if arrays else ())
            }
    except (SafetensorError, OSError, ValueError, KeyError, MemoryError) as error:  # KeyError: an unknown type
        reason = f"numbers of type {error.args[0]}" if isinstance(error, KeyError) else str(error)
        reason = next(iter(reason.splitlines()), "out of memory")
        raise SceneError(path, f"expected {what}, found a file that cannot be read ({reason})", remedy) from error
    return metadata, tensors
