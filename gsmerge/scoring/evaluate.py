"""Measure the quality of compact scenes: compare renders of the results and of the input with photos, view by view."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import count

import numpy as np
from numpy.typing import NDArray

from gsmerge.arrays import ArrayFields, as_pictures
from gsmerge.errors import Doubt, UsageError, list_doubts
from gsmerge.frozen import dataclass, field, fields, replace
from gsmerge.method.facts.pictures import OWN_PHOTOS, PHOTOS, RENDERS, ROW_COLORS
from gsmerge.method.geometry.frame import scene_frame
from gsmerge.method.geometry.views import pick_views
from gsmerge.method.raster import render
from gsmerge.method.raster.metrics import describe_loss, psnr_within, ssim_within
from gsmerge.method.raster.photos import COVERED_TRANSMITTANCE, NEAR_PLANE, WHOLE_SHARE
from gsmerge.prepare.prepare_scene import scored_pictures
from gsmerge.reading.input import check_scene
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.record import Progress
from gsmerge.runtime.threads import use_threads
from gsmerge.scoring.fog import ALL, Fog, describe_fog, measure_fog
from gsmerge.scoring.sizes import resize_mask, shrink_cameras, shrink_views
from gsmerge.scoring.visibility import context_points, visible_pixels
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.types import Cameras, Gaussians, HasGaussians, Scene, Views, own_gaussians

# Note on photos whose colours or pixels compact changes before it fits a scene to them
MENDED = (
    "the photos of the input views differ from their Gaussians, or from each other, in tone, exposure or by objects"
    " that cover them; compact mends this, but the scores here use the photos as they are"
)
SPLITS = ("context", "target")  # names of the two kinds of views: input views, and held-out views
INPUT = "input"  # name of the scene itself among the results

OnImage = Callable[[str, str, int, np.ndarray], None]  # called with result, split, number of the view, image


@dataclass(frozen=True)
class Quality:
    """Similarity of an image to a reference. A measure that was not taken is None."""

    psnr: float | None = None  # dB; inf for equal pictures
    ssim: float | None = None  # at most 1
    lpips_vgg: float | None = None  # at least 0, lower is closer
    lpips_alex: float | None = None  # at least 0, lower is closer


QualityPair = tuple[Quality, Quality]  # over all pixels, and over the pixels that the input views have seen


@dataclass(frozen=True)
class ViewScore:
    """Scores of one result in one view."""

    split: str  # "context": an input view; "target": a held-out view
    view: str  # name of the view
    visible: float  # share of the pixels that the input views have seen
    full: Quality  # over all pixels
    masked: Quality  # over the pixels that the input views have seen (supplement A)
    # Share of the pixels that the input covers, by a Gaussian that comes from the pixel, or by an opacity above a half.
    # None if the input was not measured
    covered_share: float | None = None
    covered: Quality = Quality()  # PSNR and SSIM over these pixels


@dataclass(frozen=True)
class ResultScores:
    """Scores of one result in all views."""

    name: str  # as the caller gave it
    num_gaussians: int
    ratio: float  # number of Gaussians, divided by the input's number
    render_seconds: float  # median wall time of one view with all threads
    scores: tuple[ViewScore, ...]  # one for each view
    fog: Mapping[str, Fog] = field(default_factory=dict)  # by kind of camera; empty for the input, or if not measured
    antialiased: bool = False  # how its Gaussians were drawn, see :func:`gsmerge.render`

    def __repr__(self) -> str:
        return f"ResultScores({self.name!r}, {self.num_gaussians:,} Gaussians, {len(self.scores)} views)"

    def mean(self, split: str) -> QualityPair:
        """Average the scores of a split's views.

        Returns the mean scores over all pixels, and over the pixels that the input views have seen. Raises ValueError
        if the split is neither "context" nor "target".
        """
        views = self._select_views(split)
        return _average([score.full for score in views]), _average([score.masked for score in views])

    def mean_covered(self, split: str) -> tuple[float | None, Quality]:
        """Return means over a split's views: the share of pixels that the input covers, and these pixels' scores."""
        views = self._select_views(split)
        shares = [score.covered_share for score in views if score.covered_share is not None]
        return float(np.mean(shares)) if shares else None, _average([score.covered for score in views])

    def _select_views(self, split: str) -> list[ViewScore]:
        """Return the scores of a split's views, or raise ValueError if the split is unknown."""
        if split not in SPLITS:
            raise ValueError(f"split: expected {' or '.join(SPLITS)}, got {split!r}")
        return [score for score in self.scores if score.split == split]


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(ArrayFields):
    """Scores of several results on the same views.

    Args:
        results: Scores of each result; the scene itself comes first, as "input", if it was measured.
        reference: "photos"; without photos "the model's own pixels" or "renders of the input".
        num_views: Number of views by split.
        notes: Warnings, one sentence each.
        options: Settings of the evaluation.
        pictures: ``[v,h,w,3]`` of the input views: photos, or the model's own pixels; None: renders of the input.

    Example:
        >>> scene = gsmerge.read_scene("demo")
        >>> result = gsmerge.compact(scene, effort="draft", budget=300)
        >>> quick = gsmerge.EvaluateOptions(lpips=(), fog=False)
        >>> [scores.name for scores in gsmerge.evaluate(scene, {"small": result}, options=quick).results]
        ['input', 'small']
    """

    results: tuple[ResultScores, ...]
    reference: str
    num_views: dict[str, int]
    notes: tuple[str, ...]
    options: EvaluateOptions = EvaluateOptions()
    pictures: np.ndarray | None = None

    @property
    def doubts(self) -> list[str]:
        """The notes that warn of a result that is worse than the input, or of figures that may mislead."""
        return list_doubts(self.notes)

    def __repr__(self) -> str:
        scores = ", ".join(f"{row[0]} {row[2]} dB" if len(row) > 2 else row[0] for row in self._rows()[1:])
        return f"Evaluation({scores}; against {self.reference})"

    def _rows(self) -> list[list[str]]:
        """Return a table of the results' mean scores over the pixels that the input views have seen.

        The scores are those of held-out views if there are any, otherwise those of input views.
        """
        split = "target" if "target" in self.num_views else "context"
        scores = [(result, vars(result.mean(split)[1])) for result in self.results]
        names = [name for name in vars(Quality()) if any(quality[name] is not None for _, quality in scores)]
        head = ["", "Gaussians", *(f"{name}, {self.num_views[split]} {split} views" for name in names)]
        return [head, *([result.name, f"{result.num_gaussians:,}", *(f"{quality[name]:.4g}" for name in names)]
                        for result, quality in scores)]  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Split:
    """Views of one split, with the masks and facts that their scores need."""

    views: Views
    visible: NDArray[np.bool_]  # [v,h,w] pixels that the input views have seen
    covered: NDArray[np.bool_] | None  # [v,h,w] pixels that the input covers; None: where the input is opaque
    reference: str  # words for the pictures with which results are compared, such as "photos"
    scored: Sequence[int]  # ids of the views that are scored
    masks: NDArray[np.bool_] | None  # [v,h,w] pixels that count; None: all count


@dataclass(frozen=True, eq=False)
class _Renderer:
    """Renderer of views, with the same settings for all scenes, so that equal Gaussians give equal images."""

    near: float  # near plane, world units
    options: EvaluateOptions

    def draw(self, gaussians: Gaussians, cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Render one view; return the image ``[h,w,3]`` and its alpha ``[h,w]``."""
        drawn = render(gaussians, cameras[[view]], near=self.near)
        return np.asarray(drawn.images[0].clip(0, 1)), np.asarray(drawn.alphas[0, ..., 0])

    def image(self, gaussians: Gaussians, cameras: Cameras, view: int) -> np.ndarray:
        """Render one view ``[h,w,3]``."""
        return self.draw(gaussians, cameras, view)[0]


@check_arguments
def evaluate(
    scene: Scene,
    results: Mapping[str, HasGaussians | Gaussians],
    targets: Views | None = None,
    options: EvaluateOptions | None = None,
    *,
    cameras: Mapping[str, Cameras] | None = None,
    progress: Progress = lambda *_: None,
    on_image: OnImage = lambda *_: None,
    on_alpha: OnImage = lambda *_: None,
) -> Evaluation:
    """Measure compact results, and the scene itself, on its input views and on held-out views.

    Args:
        scene: The input. Without photos, results are compared with renders of the scene.
        results: Results of :func:`gsmerge.compact`, or Gaussians, by name, in the scene's world.
        targets: Held-out views in the scene's world, see :func:`gsmerge.reading.held_out.read_held_out`.
        options: Settings; None: the defaults, with LPIPS if its weights are installed.
        cameras: Cameras of the input views, by name of a result, for results that were made with other poses than the
            scene's, or that are drawn in another way (their field ``antialiased``). Results of :func:`gsmerge.compact`
            have them as ``CompactResult.cameras``.
        progress: Called with (name of the step, number done, total); the step of a result is "evaluate: NAME".
        on_image: Called with (result, split, number of the view in the split, render ``[h,w,3]`` in [0, 1]).
        on_alpha: Called before ``on_image``, with the alpha ``[h,w]`` of the render in its place.

    Raises:
        SceneError: If the scene has values of another convention, such as log scales.
        UsageError: If the scene has no views, or if a result has the name "input".
        GsmergeError: If ``options`` ask for LPIPS and its weights are not installed. Without ``options``, LPIPS whose
            weights are not installed is left out, with a note.

    Example:
        >>> scene = gsmerge.read_scene("demo")
        >>> result = gsmerge.compact(scene, effort="fast", budget=600)
        >>> quick = gsmerge.EvaluateOptions(lpips=(), fog=False)
        >>> evaluation = gsmerge.evaluate(scene, {"small": result}, options=quick)
        >>> evaluation.num_views
        {'context': 5}
    """
    options, lpips_notes = (options, ()) if options is not None else _default_options()
    if INPUT in results:
        raise UsageError(f"results: expected names other than {INPUT!r}")
    if len(scene) == 0:
        raise UsageError("expected a scene with views, got none")
    check_scene(scene)
    scene, marks = _find_marks(scene, results, cameras or {}, options)
    original = scene if scene.images is None else replace(scene, images=as_pictures(scene.images))
    scene, mended = scored_pictures(original)
    inputs = scene.file_gaussians
    outputs = {name: own_gaussians(result).numpy() for name, result in results.items()}
    if targets is not None:
        targets = replace(targets, cameras=targets.cameras.numpy(), images=as_pictures(targets.images))
        targets = shrink_views(targets, options.photo_side)
    cameras = {name: shrink_cameras(moved.numpy(), options.photo_side) for name, moved in (cameras or {}).items()}
    with use_threads(options.threads):
        renderer = _Renderer(near_plane(scene), options)
        progress("what the input views see", 0, 0)
        pictures = PHOTOS if scene.images is original.images else ROW_COLORS
        splits = _make_splits(scene, pictures, inputs, targets, renderer)
        scored = {INPUT: inputs, **outputs} if options.own else outputs
        compared = scene.gaussians.numpy(), outputs, scene.cameras, renderer.near, progress, marks
        fog = measure_fog(*compared) if options.fog and outputs else {}
        num_pictures, numbers = len(scored) * sum(len(split.views) for split in splits.values()), count(1)

        def report_image(name: str, kind: str, view: int, image: np.ndarray, alpha: np.ndarray) -> None:
            """Pass a rendered view to the caller, and report the progress."""
            on_alpha(name, kind, view, alpha)
            on_image(name, kind, view, image)
            progress(f"evaluate: {name}", next(numbers), num_pictures)

        renderer.image(inputs[:1], scene.cameras, 0)  # loads the kernels, before times are measured
        score = partial(_score_split, results=scored, marks=marks, renderer=renderer, on_image=report_image)
        split_scores = [
            score(kind, split, cameras=cameras if kind == "context" else {}) for kind, split in splits.items()
        ]
    scores = []
    for name, gaussians in scored.items():
        timed_views = [view for views_by_name in split_scores for view in views_by_name[name]]
        seconds = float(np.median([seconds for seconds, _ in timed_views]))
        views = tuple(view for _, view in timed_views)
        ratio = len(gaussians) / max(len(inputs), 1)
        scores.append(
            ResultScores(name, len(gaussians), ratio, seconds, views, fog=fog.get(name, {}), antialiased=marks[name])
        )
    counts = {name: len(split.scored) for name, split in splits.items()}
    notes = (*lpips_notes, *_describe_scores(splits, scores, mended=mended))
    reference = _describe_references(splits)
    return Evaluation(tuple(scores), reference, counts, notes=notes, options=options, pictures=scene.images)


def _default_options() -> tuple[EvaluateOptions, Sequence[str]]:
    """Return the options of an evaluation that gives none, and a note on LPIPS if its weights are not installed."""
    from gsmerge.scoring.lpips import installed_networks

    nets, notes = installed_networks(EvaluateOptions().lpips)
    return EvaluateOptions(lpips=nets), notes


def _describe_references(splits: Mapping[str, _Split]) -> str:
    """Return words for the pictures with which results are compared, in held-out views first."""
    references = list(dict.fromkeys(splits[kind].reference for kind in ("target", "context") if kind in splits))
    return f"{references[0]}, and {references[1]} in its own views" if len(references) > 1 else references[0]


def _find_marks(
    scene: Scene, names: Iterable[str], cameras: Mapping[str, Cameras], options: EvaluateOptions
) -> tuple[Scene, dict[str, bool]]:
    """Return the scene as it is drawn, and by name of the input and of each result, whether it is drawn antialiased."""
    marks = {name: moved.antialiased for name, moved in cameras.items()}
    if options.antialiased is not None:
        scene = replace(scene, cameras=replace(scene.cameras, antialiased=options.antialiased))
        marks = {}
    return scene, {**dict.fromkeys((INPUT, *names), scene.cameras.antialiased), **marks}


def near_plane(scene: Scene) -> float:
    """Choose the near plane, in world units, for comparing a scene with its results."""
    return NEAR_PLANE * scene_frame(scene).unit


def _describe_scores(splits: Mapping[str, _Split], scores: Sequence[ResultScores], *, mended: bool) -> Iterator[str]:
    """Yield notes on results that are clearly worse than the input, and on figures that may mislead.

    ``mended`` is True if compact changes the photos before it fits a scene to them. Scores use the unchanged photos, so
    a result that was fitted to changed photos may differ from the unchanged photos for a good reason.
    """
    photos = "context" in splits and splits["context"].reference == PHOTOS
    psnrs = {score.name: score.mean("context")[0].psnr for score in scores}
    if photos and INPUT in psnrs and not mended:
        losses = (describe_loss(name, psnrs[INPUT], psnr, OWN_PHOTOS) for name, psnr in psnrs.items())
        yield from (Doubt(loss) for loss in losses if loss is not None)
    yield from filter(None, (describe_fog(score.name, score.fog[ALL]) for score in scores if score.fog))
    min_seen_share = 0.1  # if the input views have seen a smaller share of the held-out views, worlds may differ
    if "target" not in splits:
        yield "no held-out views were given; on input views, fitted results score better than on new views"
    elif (share := splits["target"].visible.mean()) < min_seen_share:
        seen = f"the input views have seen only {100 * share:.0f} % of the held-out views"
        yield Doubt(f"{seen}, which may be of another scene or in another world")
    if photos and mended:
        yield MENDED


def _make_splits(
    scene: Scene, reference: str, inputs: Gaussians, targets: Views | None, renderer: _Renderer
) -> dict[str, _Split]:
    """Return the input views and the held-out views by the name of the split, with the pixels that count.

    Input views have the scene's pictures, which ``reference`` describes. If the scene has no pictures, renders of the
    Gaussians ``inputs`` replace them.
    """
    side = renderer.options.photo_side
    cameras = shrink_cameras(scene.cameras, side)
    sources = scene.cameras if scene.has_own_pixels else cameras  # cameras whose pixels give the points
    points = context_points(scene, renderer.near, sources)

    def make_split(views: Views, words: str, masks: np.ndarray | None = None) -> _Split:
        """Return a split; ``words`` describe the pictures of the views, and pixels outside ``masks`` do not count."""
        visible = visible_pixels(points, views.cameras, renderer.near, sources)
        scored = list(range(len(views.names)))
        if masks is not None:
            masks = np.stack([resize_mask(mask, cameras.width, cameras.height) for mask in masks])
            visible &= masks
            scored = [view for view in scored if masks[view].any()] or scored
        return _Split(views, visible, covered=None, reference=words, scored=scored, masks=masks)

    held_out = {} if targets is None else {"target": make_split(targets, PHOTOS)}
    if targets is not None and not renderer.options.context:
        return held_out
    if scene.images is not None:
        views = shrink_views(Views(scene.cameras, scene.images, scene.names), side)
        context = make_split(views, reference, scene.masks)
    else:
        drawn = np.stack([renderer.image(inputs, cameras, i) for i in range(len(scene))])
        context = make_split(Views(cameras, drawn, scene.names), RENDERS, scene.masks)
    if scene.covered is not None:
        covered = np.stack([resize_mask(mask, cameras.width, cameras.height) for mask in scene.covered])
        context = replace(context, covered=covered)
    return {"context": context, **held_out}


def _score_split(
    kind: str,
    split: _Split,
    results: Mapping[str, Gaussians],
    cameras: Mapping[str, Cameras],
    marks: Mapping[str, bool],
    renderer: _Renderer,
    on_image: Callable[[str, str, int, np.ndarray, np.ndarray], None],
) -> dict[str, list[tuple[float, ViewScore]]]:
    """Draw and score all results, one view after the other.

    Returns, by the name of each result, the seconds of drawing and the score of each view. A split is a set of views:
    the input views, or held-out ones. ``kind`` is its name. If a result was made with other poses than the scene's,
    ``cameras`` has its cameras. ``marks`` says, by name, which results are drawn antialiased.
    """
    options = renderer.options
    names = split.views.names
    lpips_views = pick_views(len(names), options.lpips_views or len(names))
    # Renders of the input keep the cameras that drew them
    moved = {} if split.reference == RENDERS else cameras
    scores: dict[str, list[tuple[float, ViewScore]]] = {name: [] for name in results}
    for view in range(len(names)):
        covered = None if split.covered is None else split.covered[view]
        nets = options.lpips if view in lpips_views else ()
        for name, gaussians in results.items():
            own_cameras = replace(moved.get(name, split.views.cameras), antialiased=marks[name])
            start = time.perf_counter()
            image, alpha = renderer.draw(gaussians, own_cameras, view)
            seconds = time.perf_counter() - start
            on_image(name, kind, view, image, alpha)
            if name == INPUT and covered is None:
                covered = (1 - alpha < COVERED_TRANSMITTANCE) & (split.masks is None or split.masks[view])
            score = ViewScore(kind, names[view], float(split.visible[view].mean()), Quality(), Quality())
            if view in split.scored:
                score = _add_qualities(score, image, split, view, covered=covered, nets=nets)
            scores[name].append((seconds, score))
    return scores


def _add_qualities(
    score: ViewScore,
    image: np.ndarray,
    split: _Split,
    view: int,
    covered: NDArray[np.bool_] | None,
    nets: Sequence[str],
) -> ViewScore:
    """Add to a view's score the quality of a render over all pixels, over seen pixels, and over ``covered`` pixels."""
    photo = split.views.images[view]
    seen = split.visible[view]
    share = None if covered is None else float(covered.mean())
    covered_mask = covered if share is not None and share < WHOLE_SHARE else None
    # PSNR and SSIM over the pixels in each mask. None stands for all pixels, and an empty mask gives no measures
    masks = [None if mask is None or mask.all() else mask for mask in (None, seen, covered_mask)]
    filled = [mask for mask in masks if mask is None or mask.any()]
    measures = iter(zip(psnr_within(image, photo, filled), ssim_within(image, photo, filled), strict=True))
    full, masked, covered_quality = (
        Quality(*next(measures)) if mask is None or mask.any() else Quality() for mask in masks
    )
    if nets:
        from gsmerge.scoring.lpips import lpips, min_size

        fitting = [net for net in nets if min(image.shape[:2]) >= min_size(net)]
        full = replace(full, **{f"lpips_{net}": lpips(image, photo, net, None) for net in fitting})
        if seen.all():
            masked = full
        elif seen.any():  # without seen pixels there is no LPIPS over them
            masked = replace(masked, **{f"lpips_{net}": lpips(image, photo, net, seen) for net in fitting})
    score = replace(score, full=full, masked=masked)
    return score if share is None else replace(score, covered_share=share, covered=covered_quality)


def _average(scores: Sequence[Quality]) -> Quality:
    """Average each measure over the ``scores`` that have it."""
    means: dict[str, float | None] = {}
    for measure in fields(Quality):
        values = [getattr(score, measure.name) for score in scores]
        measured = [value for value in values if value is not None]
        means[measure.name] = float(np.mean(measured)) if measured else None
    return Quality(**means)
