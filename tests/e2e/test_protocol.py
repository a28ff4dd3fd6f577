"""The script that repeats published benchmarks, on a made scene as people have data: a folder, an export, a list."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scripts import load_script

ROOT = Path(__file__).parents[2]
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.fixture
def protocol(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return load_script(ROOT / "benchmarks" / "protocol.py")


def write_data(made: Path, data: Path) -> dict[str, list[int]]:
    """Write all frames of a made scene, targets among them, in a world that is turned and larger; return the list."""
    frames = []
    for number, (role, root) in enumerate((("context", made), ("target", made / "targets"))):
        document = json.loads((root / "transforms.json").read_text())
        shared = {key: value for key, value in document.items() if key != "frames"}
        for place, frame in enumerate(document["frames"]):
            frames.insert((number + 1) * place + number, (role, root, shared | frame))  # targets between context views
    for number, (_, root, frame) in enumerate(frames):
        name = Path("images", f"{number:03d}.png")
        (data / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(root / frame["file_path"], data / name)
        pose = np.array(frame["transform_matrix"])
        pose[:3, :3], pose[:3, 3] = TURN @ pose[:3, :3], 3 * TURN @ pose[:3, 3] + (1, 2, 3)
        frame |= {"file_path": name.as_posix(), "transform_matrix": pose.tolist()}
    (data / "transforms.json").write_text(json.dumps({"frames": [frame for *_, frame in frames[::-1]]}))
    return {role: [i for i, frame in enumerate(frames) if frame[0] == role] for role in ("context", "target")}


@pytest.mark.slow
def test_a_benchmark_is_repeated(
    protocol: ModuleType, made_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = write_data(made_scene, tmp_path / "data" / "room")
    shutil.copytree(made_scene, tmp_path / "exports" / "room")
    assert entry["context"] == [0, 2, 4, 6, 8]
    (tmp_path / "views.json").write_text(json.dumps({"room": entry, "hall": entry, "none": None}))
    words = [str(tmp_path / name) for name in ("data", "exports", "views.json")]
    protocol.main([*words, "--published", "dl3dv-6", "--set", "fit_steps=20", "superpixels=200", "--size", "60x60"])
    printed = capsys.readouterr().out
    assert "hall: no export" in printed
    assert "1 of 2 scenes" in printed
    rows = dict(re.findall(r"^\| ([^|]+) \| [^|]*\| ([\d.]+) / ", printed, re.MULTILINE))
    assert rows["ZipSplat, published"] == "25.24"
    assert float(rows["gsmerge"]) > float(rows["input"]) > 15
    with pytest.raises(SystemExit):
        protocol.main([*words, "--scenes", "cellar"])


def test_without_a_list_the_paper_s_rule_makes_one(
    protocol: ModuleType, made_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, exports = tmp_path / "data", tmp_path / "exports"
    entry = write_data(made_scene, data / "room")
    protocol.main([str(data), "--views", "5"])
    assert json.loads(capsys.readouterr().out) == {"room": entry}
    protocol.main([str(data), "--views", "9"])  # as many as there are, which leaves none to look at
    assert json.loads(capsys.readouterr().out) == {}
    shutil.copytree(made_scene, exports / "room")
    protocol.main([str(data), str(exports), "--views", "5", "--set", "effort=draft", "superpixels=200"])
    assert "1 of 1 scenes" in capsys.readouterr().out
    for words in ([str(data)], [str(data), str(exports)], [str(data), str(exports), "x.json", "--views", "5"]):
        with pytest.raises(SystemExit):
            protocol.main(words)
