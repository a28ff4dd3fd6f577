"""The file of a state: which parts it has, written and read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge import __version__
from gsmerge.networks.options import CORRECTED, GROUP
from gsmerge.settings.extend import own_settings
from gsmerge.settings.stages import MAX_CHILDREN
from gsmerge.states.division import Division
from gsmerge.states.groups import with_child_rows, without_members
from gsmerge.states.gsm_file import FEATURE_COLUMNS, GsmFile, float32, read_gsm, write_gsm
from gsmerge.states.state import (
    Colors,
    DividedGroups,
    GroupSet,
    Heads,
    Learned,
    Replay,
    State,
    StateNetworks,
    ViewSamples,
    no_photos,
)
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

if TYPE_CHECKING:
    from gsmerge.networks.weights import NetworkWeights

HEAD_COUNTS = ("views", "num_members")
LATENTS = ("refined.", "samples.", "heads.num_members")  # what later batches go on with, by the start of keys
COLORS = ("features.fitted_sh0", "features.color_precision")


def save_state(path: str | PathLike[str], state: State, *, overwrite: bool = False) -> None:
    """Write a state to a file; :func:`load_state` restores it bit for bit.

    Raises SceneError if the file exists or cannot be written.
    """
    groups, cameras, frame = state.groups, state.cameras, state.frame
    features, weights = groups.features, None
    arrays = {f"features.{name}": float32(getattr(features, name)) for name in FEATURE_COLUMNS}
    arrays |= {"features.views": features.views.astype(np.int32), "frame.origin": frame.origin.astype(np.float64)}
    arrays |= {"cameras.viewmats": cameras.viewmats.astype(np.float64), "cameras.Ks": cameras.Ks.astype(np.float64)}
    if isinstance(groups, GroupSet):
        arrays |= _gaussians("children", groups.children)
        arrays["children.counts"] = np.diff(features.starts).astype(np.uint8)
    else:
        division, heads = groups.division, groups.heads
        arrays |= _gaussians("division", division.children)
        arrays |= {"division.splits": division.splits, "division.slots": division.slots}
        arrays |= {f"division.{name}": getattr(division, name).astype(np.int32) for name in ("uniform", "growth_order")}
        if heads is not None:
            weights = heads.networks
            arrays |= {"heads.views": heads.views.astype(np.int32), "heads.group": float32(heads.group)}
    if groups.saliency is not None:
        arrays["features.saliency"] = groups.saliency
    if groups.colors is not None:
        arrays |= dict(zip(COLORS, (groups.colors.sh0, groups.colors.precision), strict=True))
    arrays |= _gaussians("kept", state.kept)
    if len(state.replay):
        arrays |= {"replay.images": state.replay.images, "replay.views": state.replay.views.astype(np.int32)}
    if state.networks is not None and groups.learned is not None:
        weights, learned, samples = state.networks.weights, groups.learned, state.networks.samples
        arrays |= {f"refined.{name}": getattr(learned.refined, name) for name in CORRECTED}
        arrays |= {f"heads.{name}": getattr(learned, name).astype(np.int32) for name in HEAD_COUNTS}
        arrays |= {f"samples.{f.name}": getattr(samples, f.name) for f in fields(ViewSamples)}
    header: dict[str, Any] = {"settings": asdict(state.settings), "unit": frame.unit, "about": dict(state.about)}
    header |= {"width": cameras.width, "height": cameras.height}
    if weights is not None:
        header["networks"] = asdict(weights.options)
        arrays |= {f"networks.{name}": array for name, array in weights.arrays.items()}
    write_gsm(path, header, arrays, overwrite=overwrite)


def _gaussians(prefix: str, gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the arrays of Gaussians by key."""
    return {f"{prefix}.{f.name}": float32(getattr(gaussians, f.name)) for f in fields(Gaussians)}


def load_state(path: str | PathLike[str]) -> State:
    """Read a state from a file, also of 0.1's commands ``encode`` and ``extend``; nothing in the file is executed.

    Raises SceneError if the file is missing or damaged, of another format or a newer schema, lacks
    an array, or holds numbers out of range.
    """
    file = read_gsm(path)
    settings, weights, features = file.settings(), file.networks(), file.features()
    common = file.common(features.shN.shape[1])
    cameras, keeps_latents, networks, learned = common["cameras"], file.has(*LATENTS), None, None
    if weights is not None and features.latents.shape[1] != weights.options.latent:
        expected = f"features.latents: expected {weights.options.latent} numbers, as of its networks"
        raise file.error(f"{expected}, found {features.latents.shape[1]}")
    divided = file.has("division.splits")
    if weights is not None and (keeps_latents or not divided):
        learned = _read_learned(file, features, weights, len(cameras))
        networks = StateNetworks(weights, _read_samples(file, len(cameras)))
    saliency = file.array("features.saliency", np.float64, len(features)) if file.has("features.saliency") else None
    groups: DividedGroups | GroupSet
    if divided:
        heads = None if weights is None else _read_heads(file, weights, len(features), len(cameras))
        colors = _read_colors(file, len(features)) if file.has(*COLORS) else None
        groups = DividedGroups(features, _read_division(file, features, heads), heads, colors, learned, saliency)
    else:
        groups = _read_groups(file, features, settings.max_k, weights)
        groups = replace(groups, learned=learned, saliency=saliency)
    return State(
        groups=groups,
        replay=_read_replay(file, cameras) if file.has("replay.") else no_photos(cameras),
        settings=settings,
        about=_read_about(file, len(groups), len(cameras), settings.num_input, has_networks=networks is not None),
        networks=networks,
        **common,
    )


def _read_about(
    file: GsmFile, num_groups: int, num_views: int, num_input: int, *, has_networks: bool
) -> Mapping[str, Any]:
    """Return options, batches and source; options are those of this version that a file may set."""
    about = dict(file.header["about"])
    if file.is_encoded:  # an encoded scene is a batch
        options = {name: value for name, value in about.get("options", {}).items() if name != "fit"}  # of another run
        batch = {"num_views": num_views, "num_input": num_input, "num_new": num_groups}
        batch |= {"num_covered": 0, "num_joined": 0, "num_hidden": 0, "num_groups": num_groups}
        source = {"source": about["source"]} if "source" in about else {}
        about = {"gsmerge": __version__, "options": options, "batches": [batch], **source}
    if not about.keys() >= {"options", "batches"}:
        raise file.error("about: expected options and batches in the header, found none")
    try:
        about["options"] = own_settings(about["options"], has_networks=has_networks)
    except ValueError as error:
        raise file.error(f"about: expected options of gsmerge, found others ({error})") from error
    return about


def _read_division(file: GsmFile, features: FeatureGaussians, heads: Heads | None) -> Division:
    """Read the children for every K, and check that every index is in range; heads may make them of nothing."""
    g = len(features)
    splits, slots = file.array("division.splits", np.uint8, g), file.array("division.slots", np.uint8, None)
    uniform = file.array("division.uniform", np.int32, None)
    order = file.array("division.growth_order", np.int32, None)
    counts = splits.astype(np.int64)
    of_nothing = heads is not None and heads.networks.options.makes_children and len(slots) == 0
    complete = len(uniform) == 0 if of_nothing else counts.sum() == len(slots)
    ok = complete and bool(counts.max(initial=0) < MAX_CHILDREN)
    if ok and not of_nothing:
        steps = np.arange(len(slots)) - np.repeat(np.cumsum(counts) - counts, counts)
        in_order = len(uniform) == 0 or bool(uniform[0] >= 0 and uniform[-1] < g and (np.diff(uniform) > 0).all())
        ok = bool((slots <= steps).all()) and in_order and not counts[uniform].any()
    if ok and len(order):
        ok = int(order.min()) >= 0 and int(order.max()) < g
        ok = ok and bool((np.bincount(order, minlength=g) <= counts).all())
    if not ok:
        raise file.error("division: expected children that belong to their groups, found others")
    children = file.gaussians("division", 2 * len(slots) + len(uniform), features.shN.shape[1])
    return Division(splits, slots, uniform.astype(np.int64), children, order.astype(np.int64))


def _read_heads(file: GsmFile, weights: NetworkWeights, num_groups: int, num_views: int) -> Heads:
    """Return the networks and their descriptions of the groups."""
    return Heads(
        weights, _read_views(file, num_groups, num_views), file.array("heads.group", np.float32, num_groups, GROUP)
    )


def _read_views(file: GsmFile, num_groups: int, num_views: int) -> np.ndarray:
    """Return the view of each group."""
    views = file.array("heads.views", np.int32, num_groups).astype(np.int64)
    if len(views) and not 0 <= int(views.min()) <= int(views.max()) < num_views:
        raise file.error("heads.views: expected views of the state, found others")
    return views


def _read_groups(file: GsmFile, features: FeatureGaussians, max_k: int, weights: NetworkWeights | None) -> GroupSet:
    """Return groups of several batches, each with 1 to ``max_k`` children, or with none if heads make them."""
    g, num_latents = len(features), features.latents.shape[1]
    if weights is None and num_latents:
        raise file.error(f"features.latents: expected 0 numbers in a state without networks, found {num_latents}")
    least, most = (0, 0) if weights is not None and weights.options.makes_children else (1, max_k)
    counts = file.array("children.counts", np.uint8, g).astype(np.int64)
    if g and not least <= int(counts.min()) <= int(counts.max()) <= most:
        raise file.error(f"children.counts: expected {least} to {most}, found others")
    children = file.gaussians("children", int(counts.sum()), features.shN.shape[1])
    return GroupSet(with_child_rows(features, np.arange(g).repeat(counts)), children, _read_colors(file, g))


def _read_colors(file: GsmFile, num_groups: int) -> Colors:
    """Return the base colours that fit the photos."""
    sh0, precision = COLORS
    return Colors(file.array(sh0, np.float32, num_groups, 1, 3), file.array(precision, np.float32, num_groups))


def _read_learned(file: GsmFile, features: FeatureGaussians, weights: NetworkWeights, num_views: int) -> Learned:
    """Return the additional data of groups in a state that keeps latents, with views and numbers checked for range."""
    g = len(features)
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,), "covars": (3, 3), "sh0": (1, 3), "latents": (weights.options.latent,),
    }  # fmt: skip
    columns = {name: file.array(f"refined.{name}", np.float32, g, *shapes.get(name, ())) for name in CORRECTED}
    sizes = file.array("heads.num_members", np.int32, g).astype(np.int64)
    if g and int(sizes.min()) < 1:
        raise file.error(f"heads.num_members: expected at least 1, found {sizes.min()}")
    return Learned(replace(without_members(features), **columns), _read_views(file, g, num_views), sizes)


def _read_samples(file: GsmFile, num_views: int) -> ViewSamples:
    """Return the sampled Gaussians of every view, equally many per view."""
    opacities = file.array("samples.opacities", np.float32, num_views, None, None)
    shape = *opacities.shape, 3
    if 0 in shape[1:]:
        raise file.error(f"samples.opacities: expected pixels of every view, found {list(opacities.shape)}")
    means, sh0 = (file.array(f"samples.{name}", np.float32, *shape) for name in ("means", "sh0"))
    return ViewSamples(means, opacities, sh0)


def _read_replay(file: GsmFile, cameras: Cameras) -> Replay:
    """Return the stored photos, if their views exist."""
    views = file.array("replay.views", np.int32, None).astype(np.int64)
    images = file.array("replay.images", np.uint8, len(views), cameras.height, cameras.width, 3)
    if len(views) and not (views[0] >= 0 and views[-1] < len(cameras) and (np.diff(views) > 0).all()):
        raise file.error("replay.views: expected views of the state, each once and in order, found others")
    return Replay(images, views)
