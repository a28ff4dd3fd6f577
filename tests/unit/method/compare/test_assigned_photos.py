"""Photos find their views by what they show, whatever their names, turns and companions are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from panoramas import cut_views, show, shrunk, take_photos
from sweeps import sweep

from gsmerge.method.compare.assign_photos import FIRST_PHOTOS, Assigner, Assignment, Candidates, assign_photos
from gsmerge.method.compare.offsets import OFFSET_PIXELS, find_offsets
from gsmerge.method.kernels.pictures import blur, turn_back

VIEWS = 6
Named = Sequence[int | None]


@pytest.fixture(scope="module")
def views() -> np.ndarray:
    return cut_views(VIEWS)


@pytest.fixture(scope="module")
def photos() -> list[np.ndarray]:
    return list(take_photos(cut_views(VIEWS)))


def assign(
    views: np.ndarray, pool: Sequence[np.ndarray], named: Named, *, exact: bool, tags: Sequence[int] | None = None
) -> list[Assignment | None]:
    candidates = Candidates(lambda photo: pool[photo], len(pool), (tags or [0] * len(pool)).__getitem__)
    return assign_photos(lambda side: show(views, side), candidates, named, exact=exact)[0]


@pytest.fixture(scope="module")
def others() -> list[np.ndarray]:
    """Return photos of another place."""
    return list(take_photos(cut_views(VIEWS, 9)))


ORDER = [3, 5, 0, 2, 4, 1]  # place of the photo in the pool of each view


def in_order(photos: list[np.ndarray]) -> tuple[list[np.ndarray], list[Assignment]]:
    """Return a pool in which photos have these places, and what has to be found."""
    return [photos[ORDER.index(place)] for place in range(VIEWS)], [Assignment(place, 0) for place in ORDER]


@sweep("exact", [True, False])
def test_photos_find_their_views_in_any_order(views: np.ndarray, photos: list[np.ndarray], exact: bool) -> None:
    pool, expected = in_order(photos)
    assert assign(views, pool, range(VIEWS), exact=exact) == expected


def test_photos_are_found_among_others(views: np.ndarray, photos: list[np.ndarray], others: list[np.ndarray]) -> None:
    pool, expected = in_order(photos)
    assert assign(views, [*pool, *others[:5]], [None] * VIEWS, exact=False) == expected


def test_turned_photos_stand_as_they_show_the_view(views: np.ndarray, photos: list[np.ndarray]) -> None:
    turns = [0, 1, 2, 3, 6, 7]
    pool = [np.ascontiguousarray(turn_back(photo, turn)) for photo, turn in zip(photos, turns, strict=True)]
    assert assign(views, pool, range(VIEWS), exact=True) == [Assignment(*pair) for pair in enumerate(turns)]
    tags = [0, 1, 2, 3, 0, 0]  # which viewers apply
    assert assign(views, pool, range(VIEWS), exact=True, tags=tags) == [Assignment(*pair) for pair in enumerate(turns)]


@pytest.mark.parametrize("exact", [True, False])
def test_a_neighbour_stands_for_no_missing_photo(views: np.ndarray, photos: list[np.ndarray], exact: bool) -> None:
    pool = [photo for view, photo in enumerate(photos) if view != 2]
    named: list[int | None] = [0, 1, None, 2, 3, 4]
    expected = [None if place is None else Assignment(place, 0) for place in named]
    assert assign(views, pool, named, exact=exact) == expected
    neighbour: list[int | None] = [0, 1, 1, 2, 3, 4]
    assert assign(views, pool, neighbour, exact=exact)[2] is None


@sweep("named", [list(range(VIEWS)), [None] * VIEWS])
def test_photos_of_another_place_show_nothing(named: Named, views: np.ndarray, others: list[np.ndarray]) -> None:
    assert assign(views, others, named, exact=True) == [None] * VIEWS


def test_photo_of_noise_is_left_out(views: np.ndarray, photos: list[np.ndarray]) -> None:
    noise = np.random.default_rng(3).random(photos[0].shape, np.float32)
    pool = [*photos[:3], noise, *photos[4:]]
    assert [view for view, each in enumerate(assign(views, pool, range(VIEWS), exact=True)) if each is None] == [3]


@pytest.mark.slow
def test_frames_of_a_film_that_show_the_views_are_found(views: np.ndarray, photos: list[np.ndarray]) -> None:
    """Of many frames a sample is compared; the film dwells on each view."""
    film = [shrunk(photos[frame * VIEWS // (2 * FIRST_PHOTOS)][None], 64)[0] for frame in range(2 * FIRST_PHOTOS)]
    chosen = assign(views[[1, 4]], film, [None, None], exact=False)
    assert [each and each.photo * VIEWS // (2 * FIRST_PHOTOS) for each in chosen] == [1, 4]


def test_parts_tell_a_neighbour_s_photo(views: np.ndarray, photos: list[np.ndarray]) -> None:
    shown = show(views, OFFSET_PIXELS)
    own = find_offsets(shown, 2, photos[2])
    assert own.verdict is True
    beside = np.roll(photos[2], 8, 1)
    moved = find_offsets(shown, 2, beside)
    assert moved.verdict is False
    assert moved.num_moved_together > moved.num_in_place
    assert find_offsets(show(views, 32), 2, photos[2]) is None  # too small for parts


def test_each_photo_is_read_once_for_its_scores(views: np.ndarray, photos: list[np.ndarray]) -> None:
    reads: list[int] = []

    def read(photo: int) -> np.ndarray:
        reads.append(photo)
        return photos[photo]

    assigner = Assigner(lambda side: show(views, side), Candidates(read, VIEWS, lambda _: 0))
    first = assigner.score_in_views([0, 2])
    again = assigner.score_in_views([2, 0, 0])
    assert sorted(reads) == [0, 2]
    np.testing.assert_array_equal(first.values[:, ::-1], again.values)


def displaced(photos: list[np.ndarray], pixels: Sequence[int]) -> Assigner:
    """Return an assigner of photos whose parts lie some pixels beside what is shown."""
    pool = [np.roll(photo, away, 1) for photo, away in zip(photos, pixels, strict=True)]
    views = cut_views(VIEWS)
    return Assigner(lambda side: show(views, side), Candidates(lambda photo: pool[photo], VIEWS, lambda _: 0))


@pytest.mark.parametrize(
    ("pixels", "elsewhere"),
    [
        ([3, -3, 2, 3, -2, 3], []),  # as wrong depth does in all views
        ([0, 0, 3, 1, 0, 0], [2]),  # as far as that in one alone
        ([3, -3, 9, 3, -2, 3], [2]),  # a neighbour's
        ([9, 9, -9, 9, -9, 9], [0, 1, 2, 3, 4, 5]),  # photos that were all taken from elsewhere
    ],
)
def test_photo_is_displaced_where_its_parts_lie_farther_off_than_others(
    photos: list[np.ndarray], pixels: Sequence[int], elsewhere: list[int]
) -> None:
    assigner, given = displaced(photos, pixels), {view: Assignment(view, 0) for view in range(VIEWS)}
    assert [view for view in given if assigner.is_displaced(view, given)] == elsewhere


@pytest.mark.slow
def test_exchanged_photos_of_which_some_lie_on_their_side(views: np.ndarray, photos: list[np.ndarray]) -> None:
    """A photo may be more like another view in another turn than that of its tag."""
    pool, expected = in_order(photos)
    turns = [0, 2, 0, 2, 2, 0]
    pool = [np.ascontiguousarray(turn_back(photo, turn)) for photo, turn in zip(pool, turns, strict=True)]
    turned = [Assignment(photo, turns[photo]) for photo, _ in expected]
    assert assign(views, pool, range(VIEWS), exact=True, tags=turns) == turned
    assert assign(views, pool, range(VIEWS), exact=True) == turned


def test_a_photo_on_its_side_turns(views: np.ndarray, photos: list[np.ndarray]) -> None:
    pool = [*photos[:4], np.ascontiguousarray(turn_back(photos[4], 2)), photos[5]]
    assert assign(views, pool, range(VIEWS), exact=True)[4] == Assignment(4, 2)


def test_right_photo_speaks_for_no_other_photo(
    views: np.ndarray, photos: list[np.ndarray], others: list[np.ndarray]
) -> None:
    """What a photo of another place reaches by chance is no name's worth, however clear a single photo is."""
    pool = [photos[0], *others[1:]]
    assert assign(views, pool, range(VIEWS), exact=True) == [Assignment(0, 0), *[None] * (VIEWS - 1)]


def test_a_view_that_shows_nothing_contradicts_no_name(views: np.ndarray, photos: list[np.ndarray]) -> None:
    """Its rows are NaN, say; a photo that stands where the views lie is none of it."""
    weights = np.ones(views.shape[:3], np.float32)
    weights[2] = 0
    pool = [*photos, np.ascontiguousarray(turn_back(photos[2], 1))]
    for photo, expected in ((2, Assignment(2, 0)), (VIEWS, None)):
        candidates = Candidates(lambda photo: pool[photo], len(pool), lambda _: 0)
        named = [0, 1, photo, 3, 4, 5]
        chosen, _ = assign_photos(lambda side: show(views, side, weights), candidates, named, exact=True)
        assert chosen == [Assignment(0, 0), Assignment(1, 0), expected, *(Assignment(view, 0) for view in (3, 4, 5))]


@pytest.mark.parametrize("seed", [0, 6, 12])
def test_a_weak_photo_of_three_is_kept_where_it_fits_first_and_a_wrong_one_is_not(seed: int) -> None:
    """Three smooth photos give few wrong pairs, whose noise says little, so that scores alone reject a right photo."""
    smooth, other = (
        np.stack([blur(view, 20) for view in cut_views(3, number)]).astype(np.float32) for number in (seed, 50 + seed)
    )
    for share, expected in ((0.25, Assignment(1, 0)), (0.0, None)):  # of the view, in its photo
        shares = np.array([0.8, share, 0.8], np.float32)[:, None, None, None]
        pool = list(take_photos(shares * smooth + (1 - shares) * other))
        assert assign(smooth, pool, [0, 1, 2], exact=True)[1] == expected
