"""The program splat-transform: where it is, what stands in for it, and the files that it reads and writes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsmerge import Gaussians
from gsmerge.errors import UsageError
from gsmerge.io.formats import sog, splat_transform
from gsmerge.io.formats.rows import Columns, to_columns
from gsmerge.io.formats.splat_transform import VARIABLE, find_program

NO_PROGRAM = "no splat-transform on the PATH, which .ci/splat-transform installs"
EVERYWHERE = {"min": [-1e9] * 3, "max": [1e9] * 3}
STAND_IN = """#!{python}
import sys
sys.path[:0] = {paths}
from splat_transform_programs import stand_in
stand_in(sys.argv[1:])
"""


def needs_program() -> pytest.MarkDecorator:
    """Return a mark that skips tests without the program; where one is named, that is an error."""
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
