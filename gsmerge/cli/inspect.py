"""``gsmerge inspect``: what was recognised."""

from __future__ import annotations

import sys

from gsmerge.cli import options as opt
from gsmerge.cli.console import one_line
from gsmerge.cli.settings import reading_of


def inspect(
    scene: opt.SceneArgument,
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    exporter: opt.DialectOption = "auto",
    quats: opt.QuatsOption = opt.Quats.auto,
    order: opt.OrderOption = opt.Order.auto,
    scene_scale: opt.SceneScaleOption = None,
    max_side: opt.MaxSideOption = None,
    json: opt.JsonOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Say what a scene holds: layout, count, bytes, cameras, images, and whether the pixels line up."""
    hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
    from gsmerge.measure.inspect import inspect as inspect_scene
    from gsmerge.measure.inspection_lines import inspection_lines
    from gsmerge.report import document_head, to_json

    found = inspect_scene(scene, cameras=cameras, images=images, opacity=opacity.value, **vars(hints)).to_dict()
    if json:
        sys.stdout.write(to_json({**document_head(), **found}))
    elif not quiet:
        print("\n".join(map(one_line, inspection_lines(found))))
