"""Arguments of public functions of the wrong type, name or range are refused in one clear line each."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes

import gsmerge

SCENE = scenes.make_scene(scenes.room(), scenes.arc(2, 24, 18))
RESULT = gsmerge.compact(SCENE, budget=50, effort="draft")
ANY: Any = gsmerge
QUICK = gsmerge.EvaluateOptions(lpips=(), fog=False)
CALLS: dict[str, Callable[[], Any]] = {
    "results: expected Mapping[a text, a result or Gaussians]": lambda: ANY.evaluate(SCENE, [RESULT.gaussians]),
    "scene: expected Scene, got str; gsmerge.read_scene": lambda: ANY.evaluate("a.ply", {}),
    "results: expected ": lambda: ANY.view(SCENE, [RESULT]),
    "cameras: expected Cameras, got NoneType": lambda: ANY.render(SCENE.gaussians, None),
    "gaussians: expected Gaussians, got CompactResult; pass the .gaussians": lambda: ANY.render(RESULT, SCENE.cameras),
    "path: expected a path, got int": lambda: ANY.read_scene(3),
    "more: expected a path, got int": lambda: ANY.read_scene("a.ply", 3),
    "images: expected a path, got ndarray": lambda: ANY.inspect("a.ply", images=np.zeros(3)),
    "progress: expected a function, got int": lambda: ANY.compact(SCENE, progress=3),
    "scene: expected Scene or a path, got Gaussians; gsmerge.read_scene": lambda: ANY.compact(SCENE.gaussians),
    "options: expected CompactOptions, got dict": lambda: ANY.compact(SCENE, {"k": 2}),
    "path: expected a path, got Gaussians": lambda: ANY.write_ply(SCENE.gaussians, "a.ply"),
    "levels: expected Sequence[Gaussians], got Gaussians": lambda: ANY.write_levels("lod-meta.json", SCENE.gaussians),
    "unknown argument 'foo'; expected cameras": lambda: ANY.read_scene("a.ply", foo=1),
    "unknown argument 'imges'; perhaps images": lambda: ANY.read_scene("a.ply", imges="photos"),
    "scene: expected Scene or a path, got int": lambda: ANY.Compactor().extend(3),
}


@pytest.mark.parametrize("line", CALLS)
def test_other_arguments_are_refused_in_one_line(line: str) -> None:
    with pytest.raises(TypeError if re.match(r"\w+: ", line) else ValueError) as caught:
        CALLS[line]()
    assert str(caught.value).startswith(line)


def test_a_result_is_taken_where_its_gaussians_are_meant(tmp_path: Path) -> None:
    of_result, plain = (gsmerge.evaluate(SCENE, {"a": each}, options=QUICK) for each in (RESULT, RESULT.gaussians))
    assert [each.scores for each in of_result.results] == [each.scores for each in plain.results]
