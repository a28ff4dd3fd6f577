"""``.torch`` chunks as pixelSplat has them; tests that import this are skipped where torch is missing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tiny_scene import Tiny

torch = pytest.importorskip("torch", reason="torch is not installed")


def rows_of(tiny: Tiny) -> torch.Tensor:
    """``[v,18]``: fx fy cx cy divided by the size, two zeros, world to camera."""
    K = tiny.K / np.array([[tiny.width], [tiny.height], [1.0]])
    head = np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0, 0], (len(tiny.names), 1))
    return torch.from_numpy(np.concatenate([head, tiny.w2c[:, :3].reshape(-1, 12)], 1)).float()


def jpeg(image: np.ndarray) -> torch.Tensor:
    ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])
    assert ok
    return torch.from_numpy(data.reshape(-1).copy())


def entry(tiny: Tiny, key: str) -> dict[str, Any]:
    return {
        "url": "", "timestamps": torch.arange(len(tiny.names)), "key": key, "cameras": rows_of(tiny),
        "images": [jpeg(image) for image in tiny.images],
    }  # fmt: skip


def save(folder: Path, *entries: dict[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(list(entries), folder / "000000.torch")
    return folder / "000000.torch"
