"""Writing pictures, as all outputs are written."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gsmerge.preview import Picture


def write_picture(path: Path, picture: Picture, *, overwrite: bool) -> None:
    """Write an 8 bit RGB picture as PNG, atomically.

    Raises:
        SceneError: If the file cannot be written.
    """
    import cv2

    from gsmerge.io import atomic_output

    _, data = cv2.imencode(".png", picture[..., ::-1])
    with atomic_output(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(data.tobytes())
