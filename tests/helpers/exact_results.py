"""``python tests/helpers/exact_results.py`` makes nine results of exact numbers, the same on every machine.

It prints their hashes as JSON, and one of all. Another processor than this one, or an emulated one, runs it with the
package and the native library for it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path
from unittest import mock

import cv2
import numpy as np

# Scene, and the calls that make its result; {scene} and {out} are filled in
RESULTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "default": ("exact", ("compact {scene} -o {out}",)),
    "no fit": ("exact", ("compact {scene} -o {out} --fit none",)),
    "full fit": ("exact", ("compact {scene} -o {out} --fit full --set fit_steps=40 --k 2 --budget 5%",)),
    "without pixels": ("rows", ("compact {scene} -o {out} --effort fast",)),
    "without pixels, no fit": ("rows", ("compact {scene} -o {out} --fit none",)),
    "a file alone": ("alone", ("compact {scene} -o {out} --effort fast",)),
    "nothing known": ("unknown", ("compact {scene} -o {out}",)),
    "a state": ("exact", ("extend {out}.gsm {scene}", "compact {out}.gsm -o {out} --effort fast")),
    "feature gaussians": (
        "exact",
        ("extend {out}.gsm {scene} --set recipe=paper --set superpixels=2%", "compact {out}.gsm -o {out} --k 2"),
    ),
}


def make_results(folder: Path, *, threads: int = 2) -> dict[str, str]:
    """Make the scenes and the results in a folder -> hashes of the results' rows by name."""
    from gsmerge.cli import main

    scenes, hashes = write_scenes(folder), {}
    for number, (name, (scene, calls)) in enumerate(RESULTS.items()):
        out = folder / f"{number}.ply"
        for call in calls:
            words = [word.format(scene=scenes[scene], out=out) for word in call.split()]
            with mock.patch.dict(os.environ, GSMERGE_THREADS=str(threads)):
                code = main([*words, "--quiet"])
            assert code == 0, (name, code)
        hashes[name] = hash_rows(out)
    return hashes


def hash_of_all(hashes: dict[str, str]) -> str:
    """Return one hash of all results."""
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()[:32]


def hash_rows(ply: Path) -> str:
    """Hash what follows the header, which names the version."""
    return hashlib.sha256(ply.read_bytes().split(b"end_header\n", 1)[1]).hexdigest()[:16]


def write_scenes(folder: Path) -> dict[str, Path]:
    """Write the scene, without its pixels, without photos and cameras, and without any of these."""
    exact = write_exact_scene(folder / "exact")
    rows = Path(shutil.copytree(exact, folder / "rows"))
    take_rows(rows / "scene.ply", 4000)
    scenes = {"exact": exact, "rows": rows}
    for name, source in (("alone", exact), ("unknown", rows)):
        (folder / name).mkdir()
        scenes[name] = Path(shutil.copy(source / "scene.ply", folder / name))
    return scenes


def write_exact_scene(folder: Path, views: int = 4, width: int = 64, height: int = 48) -> Path:
    """Write a wall with steps before it, of whole numbers over powers of two: nothing is rounded anywhere."""
    y, x = np.mgrid[:height, :width]
    depths = (256 + 2 * ((x // 8 + y // 6) % 5) - 64 * ((x - 20) ** 2 + (y - 24) ** 2 < 144)) / 128
    frames, rows = [], []
    (folder / "images").mkdir(parents=True)
    for view in range(views):
        shift = view / 8 - 3 / 16
        means = np.stack([(x + 0.5 - 32) / 64 * depths + shift, (y + 0.5 - 24) / 64 * depths, depths], -1)
        u, v = np.floor(32 * means[..., :2] + 64).astype(int).transpose(2, 0, 1)  # a texture of places in the world
        colors = np.stack([abs(9 * u % 256 - 128), abs(7 * v % 256 - 128), 2 * abs((3 * u + 5 * v) % 128 - 64)], -1)
        one = np.zeros((height, width, 14), "<f4")
        one[..., :3] = means
        one[..., 3:6] = (colors - 128) / 64
        one[..., 6] = 1 + (x + y) % 4
        one[..., 7:10] = -4.25, -4.5, -6
        one[..., 10] = 1
        rows.append(one.reshape(-1, 14))
        (folder / "images" / f"{view}.png").write_bytes(cv2.imencode(".png", colors[..., ::-1].astype(np.uint8))[1])
        pose = [[1, 0, 0, shift], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
        frames.append({"file_path": f"images/{view}.png", "transform_matrix": pose})
    colors, turns = [f"f_dc_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
    names = ["x", "y", "z", *colors, "opacity", *(f"scale_{i}" for i in range(3)), *turns]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {views * height * width}"]
    lines += [f"property float {name}" for name in names]
    (folder / "scene.ply").write_bytes("\n".join([*lines, "end_header", ""]).encode() + np.concatenate(rows).tobytes())
    lens = {"w": width, "h": height, "fl_x": 64, "fl_y": 64, "cx": 32, "cy": 24}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), encoding="utf-8")
    return folder


def take_rows(ply: Path, taken: int) -> None:
    """Keep some rows of a scene in a random order, so that no pixel is known for any."""
    head, rows = ply.read_bytes().split(b"end_header\n", 1)
    count = next(line.split()[-1] for line in head.splitlines() if line.startswith(b"element vertex"))
    table = np.frombuffer(rows, np.uint8).reshape(int(count), -1)
    some = table[np.random.default_rng(0).permutation(len(table))[:taken]]
    ply.write_bytes(head.replace(count, str(taken).encode()) + b"end_header\n" + some.tobytes())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        made = make_results(Path(place))
    json.dump({**made, "all": hash_of_all(made)}, sys.stdout, indent=1)
