"""groups -> fitted gaussians: the stages between a choice of superpixels and the finished Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import torch

from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.networks import Checkpoint, NetworkContext
from gsmerge.options import CompactOptions
from gsmerge.render.photos import scene_photos
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.backing import encode_backing
from gsmerge.stages.choose_merge import choose_merge, close_holes
from gsmerge.stages.decode import decode
from gsmerge.stages.encode import encode
from gsmerge.stages.fit import fit
from gsmerge.stages.group import Grouping
from gsmerge.stages.match import match
from gsmerge.stages.merge import merge
from gsmerge.stages.refine import refine
from gsmerge.stages.region_tree import split_counts
from gsmerge.stages.starts import views_psnr
from gsmerge.stages.unaligned import members_of, unaligned_count
from gsmerge.types import FeatureGaussians, Gaussians, PixelScene, UnalignedScene


@dataclass(frozen=True, eq=False)
class Source:
    """What Gaussians are built from.

    Args:
        scene: The canonical scene.
        members: Its Gaussians as members of groups; None where the superpixels decide who belongs to them.
        checkpoint: Networks that correct what the analytic stages make; None: those alone.
    """

    scene: PixelScene | UnalignedScene
    members: Members | None
    checkpoint: Checkpoint | None = None


@dataclass(frozen=True, eq=False)
class Merged:
    """Feature Gaussians merged across views, and what decoding them takes.

    Args:
        features: The Feature Gaussians.
        members: The scene's Gaussians that ``features.members`` points into.
        learned: Networks that correct; None: those are not used.
        ones: What they become at K = 1, where that had to be known to choose them; None elsewhere.
    """

    features: FeatureGaussians
    members: Members
    learned: NetworkContext | None
    ones: Gaussians | None = None


def build(source: Source, grouping: Grouping, options: CompactOptions, log: RunLog) -> Gaussians:
    """The Gaussians of some superpixels: encoded, merged across views, decoded, fitted to the photos.

    Args:
        source: Scene and members.
        grouping: Superpixels, and the number of Gaussians that they are to become.
        options: All settings.
        log: Told what is done.

    Returns:
        Canonical Gaussians.
    """
    merged = merged_groups(source, grouping, options, log)
    with log.stage("decode"):
        gaussians = _decoded(merged, wanted_count(merged, grouping, options), options)
        if grouping.exact and len(gaussians) > grouping.wanted:  # K each would be more than the fit may grow to
            gaussians = _decoded(merged, grouping.wanted, options)
    if source.scene.images is None or not options.fit.looks:
        return gaussians
    with log.stage("fit"):
        rival = None
        if merged.learned is not None and options.fit.fit == "full":
            rival = feature_to_gaussians(encode(source.scene, merged.members, grouping.groups, options.encode))
        del merged
        return _fitted(gaussians, source.scene, (grouping.wanted, grouping.exact), options, log, rival)


def merged_groups(source: Source, grouping: Grouping, options: CompactOptions, log: RunLog) -> Merged:
    """The Feature Gaussians of some superpixels, merged across views, with their members and any networks."""
    members = source.members
    if members is None:
        with log.stage("members"):
            members = members_of(source.scene, grouping.groups, options)
    if source.checkpoint is None:
        return Merged(_merged_features(source.scene, members, grouping, options, log, None), members, None)
    networks, cameras = source.checkpoint.networks, source.scene.cameras
    learned = NetworkContext(networks, members, cameras, options.seed)
    if options.checkpoint == "auto":
        return _better(source, (members, learned), grouping, options, log)
    log.choices["networks"] = source.checkpoint.facts()
    cut = _unchosen(grouping, options)
    return Merged(_merged_features(source.scene, members, cut, options, log, learned), members, learned)


def _better(
    source: Source, known: tuple[Members, NetworkContext], grouping: Grouping, options: CompactOptions, log: RunLog
) -> Merged:
    """Feature Gaussians with and without networks: those whose Gaussians, one for each, show the views better.

    The choice does not hang on K, so that what is encoded once is what every K would have begun with. Networks learn
    what real exports suffer from; a scene without those errors is better left as it is.
    """
    assert source.checkpoint is not None
    members, learned = known
    best: Merged | None = None
    scores: dict[str, float] = {}
    for name, used, cut in (("learned", learned, _unchosen(grouping, options)), ("analytic", None, grouping)):
        own = RunLog(log.progress, log.seconds)
        features = _merged_features(source.scene, members, cut, options, own, used)
        with own.stage("choose"):
            ones = decode(features, members, replace(options.decode, k=1), None, options.encode.rule, used)
            scores[name] = views_psnr(ones, source.scene)
        if best is None or scores[name] >= scores["learned"]:
            best, choices = Merged(features, members, used, ones), own.choices
    assert best is not None
    log.choices |= {**choices, "start_scores": scores}
    if best.learned is not None:
        log.choices["networks"] = source.checkpoint.facts()
    return best


def _unchosen(grouping: Grouping, options: CompactOptions) -> Grouping:
    """Without the choice among merges by the photos, which the networks stand in for, unless it is asked for."""
    return grouping if options.robust.robust else replace(grouping, robust=False, coarse=None)


def keep_all(scene: UnalignedScene, options: CompactOptions, log: RunLog) -> Gaussians:
    """Every Gaussian as it is, fitted to the photos: what remains to be done where none has to go.

    Merging those that share a superpixel and splitting others would only blur, pass after pass.
    """
    with log.stage("fit"):
        return _fitted(scene.gaussians, scene, (len(scene.gaussians), True), options, log)


def _merged_features(
    scene: PixelScene | UnalignedScene,
    members: Members,
    grouping: Grouping,
    options: CompactOptions,
    log: RunLog,
    learned: NetworkContext | None,
) -> FeatureGaussians:
    """One Feature Gaussian per superpixel, the merge that the photos prefer, and merging across views."""
    with log.stage("encode"):
        features = encode(scene, members, grouping.groups, options.encode, learned)
    if not grouping.robust:
        return _matched(features, options, log, learned, lambda merged: merged)
    with log.stage("robust"):
        backing = None
        if grouping.coarse is not None:
            backing = encode_backing(scene, members, grouping.coarse, options.backing)
            backing = replace(backing, latents=torch.zeros(len(backing), features.latents.shape[1]))
        photos = scene_photos(scene, 2)
        aligned = isinstance(scene, PixelScene)
        features, choice = choose_merge(features, backing, photos, options.robust, left_out=aligned)
        log.choices["merge"], log.choices["merge_scores"] = choice.name, choice.scores

    def closed(merged: FeatureGaussians) -> FeatureGaussians:
        merged, choice = close_holes(merged, backing, photos, options.robust)
        log.choices["closed"] = choice.name
        return merged

    return _matched(features, options, log, learned, closed)


def wanted_count(merged: Merged, grouping: Grouping, options: CompactOptions) -> int | None:
    """Gaussians that the groups are to become where a number is to be met and no fit grows to it; None: K each."""
    if grouping.exact and not options.fit.grows:
        return grouping.wanted
    return unaligned_count(merged.features, merged.members, grouping, options)


def _decoded(merged: Merged, wanted: int | None, options: CompactOptions) -> Gaussians:
    """The Gaussians of the groups: as many as are wanted, or K each."""
    if wanted is None and options.decode.count == 1 and merged.ones is not None:
        return merged.ones
    features, members = merged.features, merged.members
    children = None if wanted is None else split_counts(features, members, max(0, wanted - len(features)))
    return decode(features, members, options.decode, children, options.encode.rule, merged.learned)


def _matched(
    features: FeatureGaussians,
    options: CompactOptions,
    log: RunLog,
    learned: NetworkContext | None,
    finish: Callable[[FeatureGaussians], FeatureGaussians],
) -> FeatureGaussians:
    """Merged across views; where networks are loaded, in line with their neighbours; then what ``finish`` does."""
    with log.stage("match"):
        matches = match(features, options.match, learned)
        log.choices["groups"], log.choices["clusters"] = len(features), matches.count
        features = merge(features, matches, learned)
        if learned is None:
            return finish(features)
    with log.stage("refine"):
        return finish(refine(features, learned))


def _fitted(
    gaussians: Gaussians,
    scene: PixelScene | UnalignedScene,
    goal: tuple[int, bool],
    options: CompactOptions,
    log: RunLog,
    rival: Gaussians | None = None,
) -> Gaussians:
    """Gaussians that no photo shows left out, the rest fitted to the photos.

    ``goal``: how many, whether exactly; ``rival``: the start without networks, which the fit has to beat.
    """
    wanted, exact = goal
    log.choices["begun_with"] = len(gaussians)
    # where nothing grows to the number asked for, nothing may fall below it either
    settings = replace(options.fit, prune=0.0) if exact and not options.fit.grows else options.fit
    photos = scene_photos(scene), scene_photos(scene, 2)
    gaussians, report = fit(gaussians, photos, settings, wanted, options.seed, log.fit_progress, rival)
    if report:
        log.choices["fit"] = asdict(report)
        if not report.accepted:
            log.notes.append("the fit was not accepted: held-out parts of the photos did not get better")
    return gaussians
