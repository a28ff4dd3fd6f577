"""Which photo, turned how, shows which view: names propose, what photos and Gaussians show decides.

A photo that a name gives to a view stays unless another photo or turn is clearly more like the view, it is no more
like it than wrong pairs are where most names are right, or its parts lie farther from their places than those of the
others. Elsewhere the most alike photos are compared part by part: a neighbour's photo shows the same things, but in
other places.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gsmerge.evidence.offsets import NEAR_PIXELS, SAME, SIDE, PhotoOffsets, find_offsets
from gsmerge.evidence.pictures import ViewPictures
from gsmerge.evidence.scores import MARGIN, SIZES, Comparer, fisher_z, measure_noise
from gsmerge.kernels.pictures import turn_picture
from gsmerge.runtime.threads import parallel_map

DOUBT = 2.0  # standard deviations of noise up to which two scores are one, and a photo is not like its view
ALIKE = 4  # photos most like a view that are compared with it part by part
FLAT = 1 / 255  # root mean square of a picture's contrast below which it shows nothing to go by: a rounding of 8 bits
FAR = 1e6  # cost of a pair that cannot be
TOGETHER, TASKS = 8, 16  # least photos that one task compares, and most tasks: each looks at what all views show
AT_ONCE = 256  # photos of a film that are compared first, at equal distances; then those around the most alike


class Assignment(NamedTuple):
    """The photo of a view, and how it is turned; see :func:`gsmerge.kernels.pictures.turn_picture`."""

    photo: int
    turn: int


@dataclass(frozen=True, eq=False)
class Candidates:
    """Photos that may show the views of a scene."""

    read: Callable[[int], np.ndarray]  # [h,w,3] photo as it is stored, sRGB in [0, 1], of the size of Places or larger
    count: int
    tags: Sequence[int]  # turn that each photo's tag of orientation asks for


@dataclass(frozen=True, eq=False)
class _Scores:
    """Fisher's z of some photos in all views and turns, in units of the noise of wrong pairs."""

    photos: tuple[int, ...]
    values: np.ndarray  # [v,p,8]; NaN where a photo's shape cannot be that of the views
    correlations: np.ndarray  # [v,p,8]

    def of(self, view: int, assignment: Assignment) -> float:
        """Return the score of a photo in a view, turned as assigned; NaN where that cannot be."""
        return float(self.values[view, self.photos.index(assignment.photo), assignment.turn])

    def fits(self, assignment: Assignment) -> bool:
        """Return whether a photo, turned as assigned, has a shape that can be that of the views."""
        return bool(np.isfinite(self.values[:, self.photos.index(assignment.photo), assignment.turn]).any())

    def best(self) -> np.ndarray:
        """Return the score ``[v,p]`` of each photo in its best turn."""
        return np.nan_to_num(self.values, nan=-np.inf).max(2)

    def turn(self, view: int, photo: int, tag: int) -> int:
        """Return how a photo is turned: as stored or as its tag says, unless another turn is clearly better."""
        scores = np.nan_to_num(self.values[view, self.photos.index(photo)], nan=-np.inf)
        return next((turn for turn in (0, tag) if scores[turn] > scores.max() - DOUBT), int(scores.argmax()))


class Assigner:
    """Assigns photos to the views of a scene, and keeps what was compared.

    ``show`` makes pictures of the views of a size: small ones, and larger ones where these do not decide.
    """

    def __init__(self, show: Callable[[int], ViewPictures], candidates: Candidates) -> None:
        small = show(SIZES[-1])
        self.candidates, self._show = candidates, show
        self._comparer, self._correlations = Comparer(small), dict[int, np.ndarray]()
        self._offsets = dict[tuple[int, Assignment], PhotoOffsets | None]()
        self.judged = self._comparer.measure_contrast() > FLAT

    @cached_property
    def shown(self) -> ViewPictures:
        """What the views show, large enough for parts to be looked up."""
        return self._show(SIDE)

    def score(self, photos: Iterable[int]) -> _Scores:
        """Compare photos with all views."""
        ids = tuple(dict.fromkeys(photos))
        new = [photo for photo in ids if photo not in self._correlations]

        size = max(TOGETHER, -(-len(new) // TASKS))

        def compare(first: int) -> np.ndarray:
            return self._comparer.correlate([self.candidates.read(photo) for photo in new[first : first + size]])

        compared = parallel_map(compare, range(0, len(new), size))
        self._correlations |= dict(zip(new, itertools.chain(*compared), strict=True))
        correlations = np.stack([self._correlations[photo] for photo in ids], 1)
        z = fisher_z(correlations)
        middle, noise = measure_noise(z, self._comparer.least_noise)
        return _Scores(ids, (z - middle[:, None, None]) / noise, correlations)

    def compare(self, view: int, assignment: Assignment) -> float | None:
        """Compare a photo with a view part by part.

        Returns how alike they are, from 1 on, 0 where it was taken from elsewhere, and None where parts do not tell.
        """
        offsets = self.find_offsets(view, assignment)
        if offsets is None or offsets.verdict is None:
            return None
        return 1 + max(offsets.alike, 0.0) if offsets.verdict else 0.0

    def find_offsets(self, view: int, assignment: Assignment) -> PhotoOffsets | None:
        """Find where the parts of a photo lie in what a view shows; None where pictures are too small for parts."""
        if (view, assignment) not in self._offsets:
            photo = turn_picture(self.candidates.read(assignment.photo), assignment.turn)
            self._offsets[view, assignment] = find_offsets(self.shown, view, np.ascontiguousarray(photo))
        return self._offsets[view, assignment]

    def lies_elsewhere(self, view: int, given: Mapping[int, Assignment]) -> bool:
        """Return whether the parts of a given photo lie farther from their places than those of the others do.

        That is more than twice as far as these do in the middle: wrong depth displaces what is drawn in all views, but
        no farther than it moves the parts of one view apart.
        """
        offsets, others = self.find_offsets(view, given[view]), [each for each in given.items() if each[0] != view]
        if offsets is None or offsets.verdict is not False:
            return False
        known = [each.distances for each in parallel_map(lambda pair: self.find_offsets(*pair), others) if each]
        distances = np.concatenate([np.zeros(0), *known])
        usual = 2 * float(np.median(distances)) if len(distances) else 0.0
        return replace(offsets, same=SAME + min(usual, NEAR_PIXELS)).verdict is False

    def confirm(self, named: Sequence[int | None], *, exact: bool) -> tuple[list[Assignment | None], list[bool]]:
        """Return the photos that names or order give to views, and whether what they show confirms each.

        A photo stays unless another photo, that is not needed elsewhere, or another turn is clearly more like its view,
        it is no more like it than wrong pairs are where most photos are more, or its parts lie farther from their
        places than those of the others do; None in place of those that do not stay. Noise of what is drawn moves the
        scores and the parts of all photos, so that these themselves say what is to be expected of a right one.

        Photos that no other assignment makes more alike are confirmed if names are ``exact``; otherwise, and in doubt,
        the parts tell.
        """
        out, sure = list[Assignment | None]([None] * len(named)), [False] * len(named)
        given = [(view, photo) for view, photo in enumerate(named) if photo is not None]
        if not given:
            return out, sure
        scores = self.score(photo for _, photo in given)
        usual = {view: Assignment(photo, self._usual_turn(scores, view, photo)) for view, photo in given}
        columns = [scores.photos.index(photo) for _, photo in given]
        alike = scores.best()[np.ix_(list(usual), columns)]  # of each given view with each given photo
        of_names = np.nan_to_num([scores.of(*pair) for pair in usual.items()], nan=-np.inf)
        best, own = _match(alike), of_names[self.judged[list(usual)]]
        # half-way from wrong pairs to right ones, if all together are these
        least = min(DOUBT, float(np.median(own)) / 2) if _exceed_noise(own) else DOUBT
        for place, (view, assignment) in enumerate(usual.items()):
            score, most = of_names[place], max(alike[place, place], alike[place, best[place]])
            # more than wrong pairs, or most of what is seen; and no other photo or turn clearly more
            like = score > least or scores.correlations[view, columns[place], assignment.turn] ** 2 > 0.5
            like = like and score > most - DOUBT
            clear = score > MARGIN and score >= most
            if clear and exact:
                out[view], sure[view] = assignment, True
            elif like or (not self.judged[view] and scores.fits(assignment)):
                parts = self.compare(view, assignment)
                out[view] = None if self.lies_elsewhere(view, usual) else assignment
                sure[view] = bool(parts) or (clear and parts is None) or not self.judged[view]
        return out, sure

    def stand_together(self, chosen: Sequence[Assignment | None]) -> bool:
        """Return whether chosen photos together are like their views, beyond the noise of so many wrong pairs."""
        given = [(view, each) for view, each in enumerate(chosen) if each is not None and self.judged[view]]
        scores = self.score(self._correlations)
        own = [scores.of(*pair) for pair in given]
        return not own or _exceed_noise(np.array(own))

    def _usual_turn(self, scores: _Scores, view: int, photo: int) -> int:
        """Return 0 for a photo that shows a view as it is stored, or the turn of its tag if that is clearly better."""
        tag = self.candidates.tags[photo]
        stored, tagged = np.nan_to_num(scores.values[view, scores.photos.index(photo), [0, tag]], nan=-np.inf)
        return tag if tagged > stored + DOUBT else 0

    def search(self, views: Sequence[int], photos: Sequence[int]) -> dict[int, Assignment]:
        """Find the ``photos`` that show ``views``, part by part."""
        pairs = [(view, each) for view, likely in self.list_likely(views, photos).items() for each in likely]
        if not pairs:
            return {}
        scores = self.score(self._correlations)

        def compare(pair: tuple[int, Assignment]) -> float:
            alike = self.compare(*pair)
            if alike is not None:
                return alike
            score = scores.of(*pair)
            return 1 - MARGIN / score if score > MARGIN else 0.0  # less than what parts say

        return _choose(pairs, parallel_map(compare, pairs))

    def list_likely(self, views: Sequence[int], photos: Sequence[int]) -> dict[int, list[Assignment]]:
        """List the ``photos`` most alike to each of ``views``; of many a sample is tried first, then those around."""
        if not views or not photos:
            return {}
        step, tags = -(-len(photos) // AT_ONCE), self.candidates.tags
        offsets = set(range(0, len(photos), step))
        while True:
            scores = self.score(photos[place] for place in sorted(offsets))
            best = scores.best()
            likely = {view: np.argsort(-best[view], kind="stable")[:ALIKE] for view in views}
            near = {photos.index(scores.photos[column]) for ids in likely.values() for column in ids}
            around = {place + away for place in near for away in range(1 - step, step)} & set(range(len(photos)))
            if around <= offsets:
                break
            offsets, step = offsets | around, 1
        return {
            view: [
                Assignment(scores.photos[column], scores.turn(view, scores.photos[column], tags[scores.photos[column]]))
                for column in ids
                if np.isfinite(best[view, column])
            ]
            for view, ids in likely.items()
        }


def assign_photos(
    show: Callable[[int], ViewPictures],
    candidates: Candidates,
    named: Sequence[int | None],
    *,
    exact: bool,
    stored: Candidates | None = None,
) -> list[Assignment | None]:
    """Assign a photo to each view; None where none shows it.

    ``show`` makes pictures of the views of a size. ``named``: the photo that names or order propose for each view. If
    they are ``exact`` names, most of them right, a view whose photo is not there has none: others have names of their
    own. ``stored``: the photos as their files have them, where ``candidates`` are those that were brought to the views.
    """
    assigner = Assigner(show, candidates)
    out, sure = assigner.confirm(named, exact=exact)
    they_tell = 2 * sum(each is not None for each in out) > len(out) and assigner.stand_together(out)
    if exact and they_tell:  # names stand but where something speaks against them
        left = [view for view, each in enumerate(out) if each is None and named[view] is not None]
    else:
        left = [view for view, known in enumerate(sure) if not known]
    if not left:
        return out
    used = {each.photo for view, each in enumerate(out) if each is not None and view not in left}
    if stored is not None:
        assigner = Assigner(show, stored)
    others = assigner.search(left, [photo for photo in range(candidates.count) if photo not in used])
    for view in left:
        out[view] = others.get(view) or (out[view] if they_tell else None)
    return out


def _exceed_noise(scores: np.ndarray) -> bool:
    """Return whether the middle of scores ``[n]``, which no single one moves, is above that of so many wrong pairs."""
    return bool(len(scores) and np.median(scores) * np.sqrt(len(scores)) > DOUBT)


def _choose(pairs: Sequence[tuple[int, Assignment]], scores: Sequence[float]) -> dict[int, Assignment]:
    """Give each photo to one view so that all are most alike."""
    agree = [(*pair, score) for pair, score in zip(pairs, scores, strict=True) if score > 0]
    if not agree:
        return {}
    views = sorted({view for view, _, _ in agree})
    photos = sorted({assignment.photo for _, assignment, _ in agree})
    gains, chosen = np.zeros((len(views), len(photos))), dict[tuple[int, int], Assignment]()
    for view, assignment, score in agree:
        gains[views.index(view), photos.index(assignment.photo)] = score
        chosen[view, assignment.photo] = assignment
    matched = ((view, photos[column]) for view, column in zip(views, _match(gains), strict=True) if column >= 0)
    return {view: chosen[view, photo] for view, photo in matched if (view, photo) in chosen}


def _match(scores: np.ndarray) -> np.ndarray:
    """Return the column of each row of ``scores [r,c]``, each once, so that the sum is largest; -1 for none."""
    best, out = scores.argmax(1), np.full(len(scores), -1)
    if len(set(best.tolist())) == len(best):  # which needs no search
        return np.asarray(best)
    from scipy.optimize import linear_sum_assignment  # which takes long to load

    rows, columns = linear_sum_assignment(np.where(np.isfinite(scores), -scores, FAR))
    out[rows] = columns
    return out
