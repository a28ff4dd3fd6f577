"""Assign photos to views: find which photo shows which view, and in which orientation.

File names propose a photo for each view. A proposed photo is compared with the Gaussians of its view. The photo is
replaced or left out

- if another photo or another orientation matches the view clearly better,
- if it matches the view no better than photos match views that they do not show (wrong pairs), or
- if its parts lie farther from their places than the parts of the other proposed photos do.

For each view that is left without a photo, the photos with the highest scores are compared part by part. This tells
neighbouring views apart, because their photos show the same things in different places.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.compare.offsets import NEAR_PIXELS, OFFSET_PIXELS, ZERO_OFFSET, PhotoOffsets, find_offsets
from gsmerge.method.compare.similarity import NOISE_MARGIN, SCORE_PIXELS, Comparer, fisher_z, measure_noise
from gsmerge.method.compare.view_pictures import ViewPictures
from gsmerge.method.geometry.transforms import median
from gsmerge.method.kernels.pictures import turn_picture
from gsmerge.runtime.threads import parallel_map

SIGNIFICANT = 2.0  # standard deviations of noise; smaller scores and smaller differences of scores count as noise
MIN_EXPLAINED = 0.5  # a photo that explains more than this share of the variance of a view matches the view
MIN_CONTRAST = 1 / 255  # root mean square, the rounding of 8 bits; pictures with less contrast cannot be compared
FIRST_PHOTOS = 256  # evenly spaced photos of a film that are compared first; then the neighbours of the best


class Assignment(NamedTuple):
    """The photo of a view, and its orientation, 0 to 7; see :func:`gsmerge.method.kernels.pictures.turn_picture`."""

    photo: int
    orientation: int


@dataclass(frozen=True, eq=False)
class Candidates:
    """Photos that may show the views of a scene, numbered from 0."""

    # photo -> its picture [h,w,3] as it is stored, sRGB in [0, 1]; may be reduced to OFFSET_PIXELS pixels
    read: Callable[[int], np.ndarray]
    count: int
    tag: Callable[[int], int]  # photo -> orientation in its EXIF tag, 0 to 7


@dataclass(frozen=True, eq=False)
class _Scores:
    """Scores of p photos in all views and orientations: Fisher's z, divided by the noise of wrong pairs."""

    photos: tuple[int, ...]  # the p photos, in the order of the second axis
    # [v,p,8] scores; NaN for views without Gaussians, and where an oriented photo is portrait but the views are
    # landscape or vice versa
    values: np.ndarray
    correlations: np.ndarray  # [v,p,8] correlations from which the scores follow

    def of(self, view: int, assignment: Assignment) -> float:
        """Return the score of an assigned photo in a view; NaN if only the photo or only the view is portrait."""
        return float(self.values[view, self.photos.index(assignment.photo), assignment.orientation])

    def best(self) -> np.ndarray:
        """Return the score ``[v,p]`` of each photo in each view, in the best orientation."""
        return np.nan_to_num(self.values, nan=-np.inf).max(2)


class Assigner:
    """Assign photos to the views of a scene, and cache all comparisons.

    ``show(side)`` makes pictures of the views with ``side`` pixels on the longer side. Small pictures are compared
    first, and larger pictures where small pictures do not decide.
    """

    def __init__(self, show: Callable[[int], ViewPictures], candidates: Candidates) -> None:
        small = show(SCORE_PIXELS[-1])
        self.candidates = candidates
        self._show = show
        self._comparer, self._correlations = Comparer(small), dict[int, np.ndarray]()
        self._offsets = dict[tuple[int, Assignment], PhotoOffsets | None]()
        self.has_contrast = self._comparer.measure_contrast() > MIN_CONTRAST  # [v], False for views of one plain colour

    @cached_property
    def shown(self) -> ViewPictures:
        """Pictures of the views that are large enough to be compared part by part."""
        return self._show(OFFSET_PIXELS)

    def score_in_views(self, photos: Iterable[int]) -> _Scores:
        """Return the scores of photos in all views, relative to the noise among these photos."""
        ids = tuple(dict.fromkeys(photos))
        new = [photo for photo in ids if photo not in self._correlations]
        # more tasks would take longer, because each reads the pictures of all views
        min_per_task = 8
        max_tasks = 16
        task_size = max(min_per_task, -(-len(new) // max_tasks))

        def correlate_task(start: int) -> np.ndarray:
            """Return the correlations of the photos that one task compares, from the index ``start`` on."""
            return self._comparer.correlate([self.candidates.read(photo) for photo in new[start : start + task_size]])

        new_correlations = parallel_map(correlate_task, range(0, len(new), task_size))
        self._correlations |= dict(zip(new, itertools.chain(*new_correlations), strict=True))
        correlations = np.stack([self._correlations[photo] for photo in ids], 1)
        z = fisher_z(correlations)
        medians, noise = measure_noise(z, self._comparer.least_noise)
        return _Scores(ids, (z - medians[:, None, None]) / noise, correlations)

    def compare_parts(self, view: int, assignment: Assignment) -> float | None:
        """Compare a photo with a view part by part, and return their similarity.

        The similarity is at least 1 if the photo shows the view, 0 if the photo was taken from elsewhere, and None if
        the parts do not decide.
        """
        offsets = self.find_offsets(view, assignment)
        if offsets is None or offsets.verdict is None:
            return None
        return 1 + max(offsets.similarity, 0.0) if offsets.verdict else 0.0

    def find_offsets(self, view: int, assignment: Assignment) -> PhotoOffsets | None:
        """Find where the parts of a view's picture are in a photo; None if the picture is too small for parts."""
        if (view, assignment) not in self._offsets:
            photo = turn_picture(self.candidates.read(assignment.photo), assignment.orientation)
            self._offsets[view, assignment] = find_offsets(self.shown, view, np.ascontiguousarray(photo))
        return self._offsets[view, assignment]

    def is_displaced(self, view: int, assignments: Mapping[int, Assignment]) -> bool:
        """Return True if the parts of a view's photo are displaced farther than the parts of the other views' photos.

        Because wrong depth displaces the drawn Gaussians of all views, parts of the photo may be displaced by twice the
        median offset in the other views, but by no more than ``NEAR_PIXELS``.
        """
        offsets = self.find_offsets(view, assignments[view])
        if offsets is None or offsets.verdict is not False:  # even without a tolerance, the parts fit the photo
            return False
        other_pairs = [pair for pair in assignments.items() if pair[0] != view]
        other_offsets = parallel_map(lambda pair: self.find_offsets(*pair), other_pairs)
        distances = np.concatenate(
            [np.zeros(0), *(view_offsets.distances for view_offsets in other_offsets if view_offsets)]
        )
        threshold = 2 * float(np.median(distances)) if len(distances) else 0.0
        return replace(offsets, tolerance=ZERO_OFFSET + min(threshold, NEAR_PIXELS)).verdict is False

    def confirm(self, named: Sequence[int | None], *, exact: bool) -> tuple[list[Assignment | None], list[bool]]:
        """Check the photos ``named``, which file names or order propose for the views; None for no proposal.

        Returns two lists with an entry for each view: the assignment, or None if no photo is proposed or the photo is
        rejected; and whether the comparison confirms the photo. A photo is rejected

        - if another orientation, or another photo that no other view needs, scores clearly higher in its view,
        - if it scores no higher than wrong pairs do, unless it fits its view better than all other photos do, and
          better than it fits all other views, in all orientations, or
        - if its parts lie farther from their places than the parts of the other proposed photos do.

        Noisy Gaussians lower the scores of all photos and displace the parts of photos. The thresholds of rejection
        therefore follow from the scores and parts of the proposed photos themselves.

        If names are ``exact``, a photo is confirmed if its score is high and no other assignment scores higher. If the
        score does not confirm a photo, the photo is confirmed if the parts of its view's picture lie in place in it.
        """
        out = list[Assignment | None]([None] * len(named))
        confirmed = [False] * len(named)
        named_pairs = [(view, photo) for view, photo in enumerate(named) if photo is not None]
        if not named_pairs:
            return out, confirmed
        scores = self.score_in_views(photo for _, photo in named_pairs)
        columns = [scores.photos.index(photo) for _, photo in named_pairs]
        proposed = dict[int, Assignment]()
        for (view, photo), column in zip(named_pairs, columns, strict=True):  # as stored, unless its tag fits better
            tag = self.candidates.tag(photo)
            stored, tagged = np.nan_to_num(scores.values[view, column, [0, tag]], nan=-np.inf)
            proposed[view] = Assignment(photo, tag if tagged > stored + SIGNIFICANT else 0)
        best = scores.best()[np.ix_(list(proposed), columns)]  # scores of each proposed view with each proposed photo
        own = np.nan_to_num([scores.of(*pair) for pair in proposed.items()], nan=-np.inf)  # of photos in their views
        matched = _match_columns(best)
        with_contrast = own[self.has_contrast[list(proposed)]]
        # wrong pairs score about 0, and right pairs about the median, so a threshold half way separates them
        least = min(SIGNIFICANT, median(with_contrast) / 2) if _exceed_noise(with_contrast) else SIGNIFICANT
        for row, (view, assignment) in enumerate(proposed.items()):
            score = own[row]
            highest = max(best[row, row], best[row, matched[row]])
            correlation = scores.correlations[view, columns[row], assignment.orientation]
            # Few wrong pairs measure the noise badly, but a wrong photo hardly is the first in both of these ranks
            rivals = np.concatenate([scores.values[view].reshape(-1), scores.values[:, columns[row]].reshape(-1)])
            is_first = len(columns) > 1 and score >= np.nan_to_num(rivals, nan=-np.inf).max()
            is_similar = score > least or correlation**2 > MIN_EXPLAINED or is_first
            matches = is_similar and score > highest - SIGNIFICANT
            is_clear = score > NOISE_MARGIN and score >= highest
            # a photo that is portrait or landscape as the views are
            has_shape = bool(np.isfinite(scores.values[:, columns[row], assignment.orientation]).any())
            if is_clear and exact:
                out[view] = assignment
                confirmed[view] = True
            elif matches or (not self.has_contrast[view] and has_shape):
                similarity = self.compare_parts(view, assignment)
                out[view] = None if self.is_displaced(view, proposed) else assignment
                confirmed[view] = bool(similarity) or (is_clear and similarity is None) or not self.has_contrast[view]
        return out, confirmed

    def explain_most(self, assignments: Sequence[Assignment | None]) -> bool:
        """Return True if photos explain :data:`MIN_EXPLAINED` of the variance of at least half of their views."""
        pairs = [
            (view, assignment)
            for view, assignment in enumerate(assignments)
            if assignment is not None and self.has_contrast[view]
        ]
        if not pairs:
            return False
        scores = self.score_in_views(assignment.photo for _, assignment in pairs)
        correlations = [
            scores.correlations[view, scores.photos.index(photo), orientation] for view, (photo, orientation) in pairs
        ]
        return median(np.array(correlations)) > np.sqrt(MIN_EXPLAINED)

    def match_together(self, assignments: Sequence[Assignment | None]) -> bool:
        """Return True if assigned photos, taken together, match their views better than photos match other views."""
        scores = self.score_in_views(self._correlations)  # of all photos that were compared so far
        own_scores = [
            scores.of(view, assignment)
            for view, assignment in enumerate(assignments)
            if assignment is not None and self.has_contrast[view]
        ]
        return not own_scores or _exceed_noise(np.array(own_scores))

    def search(self, views: Sequence[int], photos: Sequence[int]) -> dict[int, Assignment]:
        """Find which of ``photos`` show ``views``, and return the assignment of each view that a photo shows.

        The photos with the highest scores in a view are compared with it part by part.
        """
        likely_by_view = self.list_likely(views, photos)
        pairs = [(view, assignment) for view, likely in likely_by_view.items() for assignment in likely]
        if not pairs:
            return {}
        scores = self.score_in_views(self._correlations)

        def compare(pair: tuple[int, Assignment]) -> float:
            """Return the similarity of parts, or if parts do not decide, a number below 1 that follows the score."""
            similarity = self.compare_parts(*pair)
            if similarity is not None:
                return similarity
            score = scores.of(*pair)
            return 1 - NOISE_MARGIN / score if score > NOISE_MARGIN else 0.0

        similarities = parallel_map(compare, pairs)
        # at most one pair for each view and each photo, so that the sum of their similarities is largest
        possible = [(*pair, similarity) for pair, similarity in zip(pairs, similarities, strict=True) if similarity > 0]
        if not possible:
            return {}
        rows = sorted({view for view, _, _ in possible})
        columns = sorted({assignment.photo for _, assignment, _ in possible})
        table = np.zeros((len(rows), len(columns)))
        assignments = dict[tuple[int, int], Assignment]()
        for view, assignment, similarity in possible:
            row = rows.index(view)
            column = columns.index(assignment.photo)
            table[row, column] = similarity
            assignments[row, column] = assignment
        pairs_of_table = enumerate(_match_columns(table).tolist())  # column -1 for a row that gets none
        return {rows[row]: assignments[row, column] for row, column in pairs_of_table if (row, column) in assignments}

    def list_likely(self, views: Sequence[int], photos: Sequence[int]) -> dict[int, list[Assignment]]:
        """List the ``photos`` with the highest scores in each of ``views``, the best first.

        If there are many photos, an evenly spaced sample is compared first, then the photos around the best of them.
        """
        if not views or not photos:
            return {}
        step = -(-len(photos) // FIRST_PHOTOS)
        compared = set(range(0, len(photos), step))  # indices into ``photos``
        max_compared = 4  # number of photos that are compared with a view part by part
        while True:  # until all neighbours of the views' best photos are compared
            scores = self.score_in_views(photos[index] for index in sorted(compared))
            best = scores.best()
            columns = {view: np.argsort(-best[view], kind="stable")[:max_compared] for view in views}
            peaks = {photos.index(scores.photos[column]) for ids in columns.values() for column in ids}
            neighbours = {peak + offset for peak in peaks for offset in range(1 - step, step)}
            neighbours &= set(range(len(photos)))
            if neighbours <= compared:
                break
            compared = compared | neighbours
            step = 1

        # The orientation in which a photo shows a view: the stored orientation, 0, is tried first, and that of its tag
        # next. Each is chosen if no other scores clearly higher, or else the orientation with the highest score
        likely: dict[int, list[Assignment]] = {view: [] for view in views}
        for view in views:
            for column in columns[view]:
                if np.isfinite(best[view, column]):
                    photo = scores.photos[column]
                    values = np.nan_to_num(scores.values[view, column], nan=-np.inf)
                    tried = (0, self.candidates.tag(photo))
                    proposed = (turn for turn in tried if values[turn] > values.max() - SIGNIFICANT)
                    likely[view].append(Assignment(photo, next(proposed, int(values.argmax()))))
        return likely


def assign_photos(
    show: Callable[[int], ViewPictures],
    candidates: Candidates,
    named: Sequence[int | None],
    *,
    exact: bool,
    stored: Candidates | None = None,
) -> tuple[list[Assignment | None], bool]:
    """Assign a photo to each view.

    Args:
        show: ``show(side)`` makes pictures of the views with ``side`` pixels on the longer side.
        candidates: The photos.
        named: The photo that names or order propose for each view, or None.
        exact: The proposal is by names. If most names prove right, a view gets no photo if no photo has its name,
            because all photos have the names of other views.
        stored: The photos as stored in their files, if ``candidates`` are resampled to the views.

    Returns:
        The assignment of each view, None where no photo shows it; and True if the proposed photos explain most views.
    """
    assigner = Assigner(show, candidates)
    assignments, confirmed = assigner.confirm(named, exact=exact)
    num_assigned = sum(assignment is not None for assignment in assignments)
    most_match = 2 * num_assigned > len(assignments) and assigner.match_together(assignments)
    explain_most = assigner.explain_most(assignments)
    if exact and most_match:  # search only for the views whose proposed photo was rejected
        unknown = [view for view, photo in enumerate(named) if photo is not None and assignments[view] is None]
    else:
        unknown = [view for view, is_confirmed in enumerate(confirmed) if not is_confirmed]
    if not unknown:
        return assignments, explain_most
    used = {assigned.photo for view, assigned in enumerate(assignments) if assigned and view not in unknown}
    if stored is not None:
        assigner = Assigner(show, stored)
    results = assigner.search(unknown, [photo for photo in range(candidates.count) if photo not in used])
    for view in unknown:
        assignments[view] = results.get(view) or (assignments[view] if most_match else None)
    return assignments, explain_most


def _exceed_noise(scores: np.ndarray) -> bool:
    """Return True if the median of scores ``[n]`` is significantly above 0, the median of wrong pairs.

    The test uses the median, because a single extreme score hardly moves a median.
    """
    return bool(len(scores) and median(scores) * np.sqrt(len(scores)) > SIGNIFICANT)


def _match_columns(scores: np.ndarray) -> np.ndarray:
    """Choose a column ``[r]`` for each row of ``scores [r,c]``, so that the sum of the chosen scores is largest.

    No column is chosen twice. The result is -1 for a row that gets no column.
    """
    best = scores.argmax(1)
    out = np.full(len(scores), -1)
    if len(set(best.tolist())) == len(best):  # the best columns differ, so no search is needed
        return np.asarray(best)
    from scipy.optimize import linear_sum_assignment  # here because it takes long to load

    impossible_cost = 1e6  # cost of a photo and a view whose shapes differ
    rows, columns = linear_sum_assignment(np.where(np.isfinite(scores), -scores, impossible_cost))
    out[rows] = columns
    return out
