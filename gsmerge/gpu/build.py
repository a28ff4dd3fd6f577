"""Superpixels to fitted Gaussians on a device, with one upload and one download; ``build`` of :mod:`gsmerge.pipeline`.

What a function here does not do, the stage on the CPU does, and the log's choices say so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from gsmerge.gpu import decode as on_device_decode
from gsmerge.gpu import match as on_device_match
from gsmerge.gpu import segment as on_device_segment
from gsmerge.gpu.fit import ON_DEVICE
from gsmerge.gpu.match import merge
from gsmerge.gpu.pool import encode
from gsmerge.gpu.runs import group_rows
from gsmerge.gpu.scene import (
    DeviceMembers,
    DevicePhotos,
    Features,
    download_features,
    download_groups,
    to_device,
    upload_gaussians,
    upload_members,
    upload_pair,
    upload_photos,
)
from gsmerge.gpu.score import photo_psnr
from gsmerge.render.cuda import start_cuda
from gsmerge.render.photos import NEAR, photos_of
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.agreement import agreement_factors
from gsmerge.stages.decode import decode_merged
from gsmerge.stages.fit import fit as fit_on_cpu
from gsmerge.stages.fit.photos import fit_photos, photo_scale
from gsmerge.stages.fit.stage import fit_with
from gsmerge.stages.group import segment_scene
from gsmerge.stages.match import match as match_on_cpu
from gsmerge.stages.merge import MergedViews
from gsmerge.stages.prepare import PreparedScene
from gsmerge.stages.segment import scene_saliency
from gsmerge.types import Gaussians, PixelScene, Segmentation

Begin = Callable[[PreparedScene, int | None, RunLog], tuple[Gaussians, int, bool, Gaussians | None]]


@dataclass(frozen=True, eq=False)
class Superpixels:
    """The superpixels of a scene on a device; :class:`gsmerge.types.Segmentation`.

    Args:
        labels: ``[v,h,w]`` int64, from 0 in every view.
        counts: Superpixels of each view.
        count: Gaussians in the end.
        exact: Whether that number is to be met.
    """

    labels: Tensor
    counts: tuple[int, ...]
    count: int
    exact: bool


def merge_problem(prepared: PreparedScene) -> str | None:
    """Why everything up to decoding runs on the CPU, as a clause; None where it need not."""
    if not isinstance(prepared.scene, PixelScene):
        return "the scene is unaligned"
    if prepared.checkpoint is not None:
        return "networks correct the stages"
    if prepared.limits.robust:
        return "the photos choose the merge"
    return None if prepared.options.encode.rule == "depth" else f"rule {prepared.options.encode.rule}"


class DeviceScene:
    """A prepared scene on a device; what is used is uploaded once.

    Args:
        prepared: The scene.
        device: Where.
        begin: All arrows before the fit on the CPU: Gaussians, the number that they may grow to, whether it is to be
            met, and another start that the fit may beat instead.
    """

    def __init__(self, prepared: PreparedScene, device: torch.device | str, begin: Begin):
        self.prepared, self.device, self.begin = prepared, torch.device(device), begin
        if self.device.type == "cuda":
            start_cuda(self.device)

    @cached_property
    def members(self) -> DeviceMembers:
        """The Gaussians of an aligned scene."""
        assert self.prepared.members is not None
        return upload_members(self.prepared.members, self.device)

    @cached_property
    def photos(self) -> tuple[DevicePhotos, DevicePhotos]:
        """The photos at full and at half size."""
        return upload_pair(self.prepared.scene, self.device)

    @cached_property
    def fit_photos(self) -> tuple[DevicePhotos, DevicePhotos]:
        """Those of them that a fit may use."""
        views = self.prepared.photo_views
        if len(views) == len(self.prepared.scene):
            return self.photos
        full, half = (upload_photos(photos.host[views], self.device) for photos in self.photos)
        return full, half

    @cached_property
    def pictures(self) -> Tensor:
        """``[v,h,w,3]`` what superpixels are cut from."""
        if self.prepared.scene.images is not None:
            return self.photos[0].images
        return to_device(self.prepared.pictures, self.device, torch.float32)

    @contextmanager
    def stage(self, log: RunLog, name: str) -> Iterator[None]:
        """A stage of the log, which ends when the device is done."""
        with log.stage(name):
            yield
            if self.device.type == "cuda":
                torch.cuda.synchronize(self.device)

    def build(self, prepared: PreparedScene, count: int | None, log: RunLog) -> Gaussians:
        """Every arrow after the preparation; arguments and result as of :func:`gsmerge.pipeline.build`."""
        scene, options = prepared.scene, prepared.options
        reasons: dict[str, str] = {}
        assert scene.gaussians is self.prepared.scene.gaussians  # its cameras may have moved
        other, keeps_all = None, prepared.keeps_all(count)
        problem = "nothing is merged" if keeps_all else merge_problem(prepared)
        if problem is None:
            gaussians, count, exact = self._merge(prepared, count, log, reasons)
        else:
            start, count, exact, analytic = self.begin(prepared, count, log)
            gaussians = upload_gaussians(start, self.device)
            other = None if analytic is None else upload_gaussians(analytic, self.device)
            reasons["merging"] = problem
        log.choices |= {"device": self.device.type} | ({"on_cpu": reasons} if reasons else {})
        if scene.images is None or not options.fit.needs_photos:
            return gaussians.numpy()
        scale, problem = photo_scale(scene, options.fit)
        log.choices["begun_with"] = len(gaussians)
        if scale > 1:
            reasons["fit"] = f"photo_scale {scale:.3g}"
            log.choices["on_cpu"] = reasons
            start, other_start = gaussians.numpy(), None if other is None else other.numpy()
            with log.stage("fit"):
                photos = fit_photos(scene, options.fit, log, prepared.photo_views)
                gaussians, report = fit_on_cpu(
                    start, photos, options.fit, count, options.seed, log.fit_progress, other_start, exact=exact
                )
        else:
            log.notes += [] if problem is None else [problem]
            with self.stage(log, "fit"):
                settings = options.fit, count, options.seed, log.fit_progress, other
                gaussians, report = fit_with(ON_DEVICE, gaussians, self.fit_photos, *settings, exact=exact)
                gaussians = gaussians.numpy()
        log.add_fit(report)
        return gaussians

    def _merge(
        self, prepared: PreparedScene, count: int | None, log: RunLog, reasons: dict[str, str]
    ) -> tuple[Gaussians, int, bool]:
        """The arrows up to decoding of an aligned scene -> Gaussians, their number in the end, if it is to be met."""
        options = prepared.options
        with self.stage(log, "segment"):
            cut = self._segment(prepared, count, reasons)
        with self.stage(log, "encode"):
            features = self._encode(prepared, cut)
        with self.stage(log, "match"):
            clusters, num_clusters = _match(features, prepared, reasons)
            merged = merge(features, clusters, num_clusters)
        log.choices |= {"groups": len(features), "clusters": num_clusters}
        with self.stage(log, "decode"):
            if on_device_decode.covers(options.decode):
                wanted = cut.count if cut.exact and not options.fit.grows else None
                gaussians = on_device_decode.decode(merged, self.members, options.decode, wanted, exact=True)
                if cut.exact and len(gaussians) > cut.count:  # K each would be more than the fit may grow to
                    gaussians = on_device_decode.decode(merged, self.members, options.decode, cut.count)
            else:
                reasons["decode"] = f"k {options.decode.k}"
                gaussians = self._decode_on_cpu(prepared, merged, cut)
        return gaussians, cut.count, cut.exact

    def _segment(self, prepared: PreparedScene, count: int | None, reasons: dict[str, str]) -> Superpixels:
        """Superpixels of every view, by the stage where :mod:`gsmerge.gpu.segment` does not cut them."""
        options, limits = prepared.options.segment, prepared.limits
        if count is None and on_device_segment.covers(options):
            each = max(1, int(limits.per_view * limits.share))
            labels = on_device_segment.segment(self.pictures, options, each)
            return Superpixels(labels, (each,) * len(labels), limits.default, exact=False)
        method = f"segmentation {options.segmentation}"
        reasons["segment"] = method if count is None else "a number is cut from the region tree"
        made = segment_scene(prepared, count)
        labels = to_device(made.groups.labels, self.device, torch.int64)
        return Superpixels(labels, made.groups.counts, made.count, made.exact)

    def _encode(self, prepared: PreparedScene, cut: Superpixels) -> Features:
        """One Feature Gaussian per superpixel that has a member."""
        assert isinstance(prepared.scene, PixelScene)
        first = torch.tensor([0, *cut.counts[:-1]], device=self.device).cumsum(0)
        valid = to_device(prepared.scene.valid, self.device)
        numbers = torch.where(valid, cut.labels + first[:, None, None], -1).reshape(-1)
        rows = group_rows(numbers, sum(cut.counts))
        features = encode(self.members, rows, torch.searchsorted(first, rows.groups, right=True) - 1)
        if not (prepared.options.encode.agreement and prepared.limits.share < 1):  # no long fit follows
            return features
        assert prepared.members is not None
        means, sh0, views = (tensor.cpu().numpy() for tensor in (features.means, features.sh0, features.views))
        factors = agreement_factors(means, sh0, views, prepared.members, prepared.scene.cameras)
        return replace(features, gains=features.gains * to_device(factors, self.device))

    def _decode_on_cpu(self, prepared: PreparedScene, merged: Features, cut: Superpixels) -> Gaussians:
        """Gaussians by the stage, for what :func:`gsmerge.gpu.decode.covers` leaves out."""
        assert prepared.members is not None
        options = prepared.options
        segmentation = Segmentation(download_groups(cut.labels, cut.counts), None, cut.count, cut.exact)
        saliency = scene_saliency(prepared.pictures)
        views = MergedViews(download_features(merged), prepared.members, segmentation, saliency=saliency)
        gaussians = decode_merged(views, options.decode, options.encode.rule, grows=options.fit.grows)
        return upload_gaussians(gaussians, self.device)

    def input_psnr(self, gaussians: Gaussians, prepared: PreparedScene) -> float:
        """Mean PSNR (dB) of the input photos; arguments as of :func:`gsmerge.pipeline.input_psnr`.

        Rendered in the canonical frame, where the input's own Gaussians are on the device already.
        """
        given, scene, members = prepared.given, prepared.scene, prepared.members
        if gaussians is given.gaussians and len(gaussians) == len(scene.gaussians) and members and not prepared.moved:
            gaussians = self.members.gaussians
        else:
            gaussians = upload_gaussians(prepared.frame.enter(gaussians), self.device)
        if given.images is scene.images and not prepared.moved:
            photos = self.photos[0]
        else:
            cameras = prepared.frame.enter_cameras(given.cameras)
            assert given.images is not None
            photos = upload_photos(photos_of(given.images, cameras), self.device)
        quarter = prepared.options.budget.target_psnr is None
        return photo_psnr(gaussians, photos, prepared.scored_views(), near=NEAR, quarter=quarter)


def _match(features: Features, prepared: PreparedScene, reasons: dict[str, str]) -> tuple[Tensor, int]:
    """Clusters of the Feature Gaussians, and their number."""
    options = prepared.options.match
    if on_device_match.covers(options, len(features)):
        return on_device_match.match(features, options)
    few = len(features) <= on_device_match.MAX_FEATURES
    reasons["match"] = f"match {options.method}" if few else f"{len(features)} Feature Gaussians"
    matches = match_on_cpu(download_features(features), options)
    return to_device(matches.clusters, features.means.device), matches.count
