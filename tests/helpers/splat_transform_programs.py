"""The program splat-transform: where it is, what stands in for it, and the files that it reads and writes."""

from __future__ import annotations

import json
import os
import re
import struct
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from gsmerge import Gaussians
from gsmerge.errors import UsageError
from gsmerge.io.formats import sog, splat_transform
from gsmerge.io.formats.arrays import Columns, to_columns
from gsmerge.io.formats.splat_transform import VARIABLE, find_program
from gsmerge.kernels import elementary

NO_PROGRAM = "no splat-transform on the PATH, which .ci/splat-transform installs"
EVERYWHERE = {"min": [-1e9] * 3, "max": [1e9] * 3}
STAND_IN = """#!{python}
import sys
sys.path[:0] = {paths}
from splat_transform_programs import stand_in
stand_in(sys.argv[1:])
"""


def needs_program() -> pytest.MarkDecorator:
    """A mark that skips tests without the program; where one is named, that is an error."""
    try:
        found = bool(find_program())
    except UsageError:
        found = False
    if not found and os.environ.get(VARIABLE):
        raise RuntimeError(f"{VARIABLE}: expected a program, found none")
    return pytest.mark.skipif(not found, reason=NO_PROGRAM)


def put_stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str = STAND_IN) -> Path:
    """Make a script, by default one that does the least that the program would, the program of the test."""
    if os.name == "nt":
        pytest.skip("scripts are no programs on Windows")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "splat-transform"
    paths = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
    path.write_text(text.replace("{python}", sys.executable).replace("{paths}", repr(paths)))
    path.chmod(0o755)
    monkeypatch.setenv(VARIABLE, str(path))
    return path


def run_here(monkeypatch: pytest.MonkeyPatch, program: Path) -> None:
    """Let a stand-in do its work in this process; one of its own takes a second to load what it needs."""

    def run(command: Sequence[str], **_: Any) -> subprocess.CompletedProcess[bytes]:
        assert command[0] == str(program)
        stand_in(command[1:])
        return subprocess.CompletedProcess(command, 0, b"", b"")

    seen = SimpleNamespace(**{**vars(subprocess), "run": run})
    monkeypatch.setattr(splat_transform, "subprocess", seen)


def stand_in(words: Sequence[str]) -> None:
    """Write the last of the words: levels, a page, the first rows of a ``.ply``, or a copy of one by any name."""
    from gsmerge.io import read_ply, write_ply

    assert words[:4] == ["-q", "-w", "-g", "cpu"]
    out, plys = Path(words[-1]), [word for word in words[4:-1] if word.endswith(".ply")]
    if out.name == "lod-meta.json":
        tags = re.findall(r"(\S+\.ply) -l (\d+)", " ".join(words))
        assert [int(level) for _, level in tags] == list(range(len(plys)))
        files = [read_ply(ply) for ply in plys]
        write_set(out, [file.gaussians for file in files], mip="SplatRenderMode: mip" in files[0].info.comments)
    elif "-d" in words:
        count = int(words[words.index("-d") + 1])
        write_ply(out, read_ply(words[4], opacity="logit").gaussians[:count])
    else:
        out.write_bytes(Path(words[4]).read_bytes())


def write_set(
    path: Path, levels: Sequence[Gaussians], *, mip: bool = False, leaves: int = 1, environment: Gaussians | None = None
) -> None:
    """Write a Streamed SOG of one chunk for each level, each cut into as many runs as there are leaves."""
    path.parent.mkdir(parents=True, exist_ok=True)
    nodes: list[dict] = [{"bound": EVERYWHERE, "lods": {}} for _ in range(leaves)]
    for level, gaussians in enumerate(levels):
        columns = to_columns(gaussians, sog.MAX_DEGREE).along_curve()
        write_unbundled(path.parent / f"{level}_0", columns, mip=mip)
        cuts = np.linspace(0, len(columns), leaves + 1).astype(int).tolist()
        for node, start, end in zip(nodes, cuts, cuts[1:], strict=False):
            node["lods"][str(level)] = {"file": level, "offset": start, "count": end - start}
    counts = [len(level) for level in levels]
    index = {"version": 1, "asset": {}, "count": sum(counts), "counts": counts, "lodLevels": len(levels)}
    if environment is not None:
        write_unbundled(path.parent / "env", to_columns(environment, sog.MAX_DEGREE))
        index["environment"] = "env/meta.json"
    tree = nodes[0] if leaves == 1 else {"bound": EVERYWHERE, "children": nodes}
    index |= {"filenames": [f"{level}_0/meta.json" for level in range(len(levels))], "tree": tree}
    path.write_text(json.dumps(index))


def write_unbundled(folder: Path, columns: Columns, *, mip: bool = False) -> None:
    """Write a ``meta.json`` of version 2 with its textures."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in sog.sog_files(columns, "mip" if mip else None).items():
        (folder / name).write_bytes(data)


def write_sog_1(folder: Path, gaussians: Gaussians) -> None:
    """Write a ``meta.json`` of version 1, without higher harmonics: scales and colours are bytes of a range."""
    columns = to_columns(gaussians, 0)
    write_unbundled(folder, columns)
    meta = json.loads((folder / "meta.json").read_text())
    opacities = columns.opacities.clip(1e-6, 1 - 1e-6)
    logits = elementary.log(opacities / (1 - opacities))
    count = len(columns)
    document = {"quats": {**meta["quats"], "shape": [count, 4], "encoding": "quaternion_packed"}}
    document["means"] = {**meta["means"], "shape": [count, 3]}
    for key, values in {"scales": columns.log_scales, "sh0": np.concatenate([columns.sh0, logits[:, None]], 1)}.items():
        low, high = values.min(0), values.max(0)
        codes = np.rint(255 * (values - low) / np.maximum(high - low, 1e-9)).astype(np.uint8)
        texture = np.full((-(-count // 4), 4, 4), 255, np.uint8)
        texture.reshape(-1, 4)[:count, : values.shape[1]] = codes
        _, data = cv2.imencode(".webp", texture[..., [2, 1, 0, 3]], [cv2.IMWRITE_WEBP_QUALITY, 101])
        (folder / f"{key}.webp").write_bytes(data.tobytes())
        document[key] = {"mins": low.tolist(), "maxs": high.tolist(), "files": [f"{key}.webp"]}
    (folder / "meta.json").write_text(json.dumps(document))


def write_ksplat(path: Path, gaussians: Gaussians) -> None:
    """Write a ``.ksplat`` of one section that is not compressed, without higher harmonics."""
    columns, count = to_columns(gaussians, 0), len(gaussians)
    head, section = bytearray(4096), bytearray(1024)
    struct.pack_into("<4B4IH", head, 0, 0, 1, 0, 0, 1, 1, count, count, 0)
    struct.pack_into("<4IfH2xI4x2IH", section, 0, count, count, 256, 0, 5.0, 12, 0, 0, 0, 0)
    rows = np.zeros(count, [("means", "<f4", 3), ("scales", "<f4", 3), ("quats", "<f4", 4), ("colors", "u1", 4)])
    rows["means"], rows["scales"], rows["quats"] = columns.means, elementary.exp(columns.log_scales), columns.quats
    rows["colors"] = np.rint(255 * np.concatenate([columns.colors, columns.opacities[:, None]], 1).clip(0, 1))
    path.write_bytes(bytes(head) + bytes(section) + rows.tobytes())


def write_lcc(folder: Path, gaussians: Gaussians) -> Path:
    """Write a ``meta.lcc`` of two levels, the second with every fourth Gaussian, without higher harmonics."""
    parts = [to_columns(part, 0) for part in (gaussians, gaussians[::4])]
    scales = elementary.exp(parts[0].log_scales)
    low, high = scales.min(), scales.max()
    record = [("means", "<f4", 3), ("colors", "u1", 4), ("scales", "<u2", 3), ("quat", "<u4"), ("normal", "<u2", 3)]
    data, index = b"", struct.pack("<2h", 0, 0)
    for part in parts:
        rows = np.zeros(len(part), record)
        rows["means"] = part.means
        rows["colors"] = np.rint(255 * np.concatenate([part.colors, part.opacities[:, None]], 1).clip(0, 1))
        rows["scales"] = np.rint(65535 * (elementary.exp(part.log_scales) - low) / (high - low))
        rows["quat"] = 3 << 30 | 512 << 20 | 512 << 10 | 512  # about the identity
        index += struct.pack("<iqi", len(part), len(data), rows.nbytes)
        data += rows.tobytes()
    folder.mkdir(parents=True, exist_ok=True)
    ranges = {"scale": (low, high), "shcoef": (-1, 1)}
    attributes = [{"name": name, "min": [float(a)] * 3, "max": [float(b)] * 3} for name, (a, b) in ranges.items()]
    meta = {"fileType": "Portable", "attributes": attributes, "splats": list(map(len, parts)), "totalLevel": 2}
    (folder / "meta.lcc").write_text(json.dumps(meta))
    (folder / "index.bin").write_bytes(index)
    (folder / "data.bin").write_bytes(data)
    return folder / "meta.lcc"


def write_lcc2(folder: Path, gaussians: Gaussians) -> Path:
    """Write a ``meta.lcc2`` of two levels, the second with every fourth Gaussian, as ``.sog`` files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, part in {"fine": gaussians, "coarse": gaussians[::4]}.items():
        (folder / f"{name}.sog").write_bytes(sog.sog_bytes(part))
    fine = {"data": {"3dgs": {"name": 0}}}
    root = {"splatFiles": ["fine.sog", "coarse.sog"], "child": [{"data": {"3dgs": {"name": 1}}, "child": [fine]}]}
    counts = [len(gaussians), len(gaussians[::4])]
    meta = {"totalSplats": sum(counts), "lodSplats": counts, "totalLevels": 2, "splatType": ".sog", "root": root}
    (folder / "meta.lcc2").write_text(json.dumps(meta))
    return folder / "meta.lcc2"
