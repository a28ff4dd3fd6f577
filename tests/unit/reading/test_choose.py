"""Cameras and photos are chosen by evidence, which is made up here."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from messages import noted

from gsmerge.errors import Doubt, Note, SceneError
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.reading.alignment import ESTIMATED, CameraCheck
from gsmerge.reading.candidates import WAYS, Candidate, Views, list_candidates
from gsmerge.reading.choice import Choice, candidate_lines
from gsmerge.reading.choose import (
    Evidence,
    blames_photos,
    certainly_fits,
    choose,
    choose_photos,
    explain_refusal,
    find_cause,
    give_reasons,
    is_needed,
    needs_bare,
    release_spare,
)
from gsmerge.reading.photos.scene_photos import MismatchError, ScenePhotos
from gsmerge.reading.scene_files import SceneFiles

FOLDER = Path("scene")
FIRST, SECOND, IMAGES = FOLDER / "transforms.json", FOLDER / "sparse/0", FOLDER / "images"
FILES = SceneFiles(FOLDER / "a.ply", FIRST, IMAGES, root=FOLDER, others=(SECOND,))
LISTED = list_candidates(FILES)
CAMERAS = [one for one in LISTED if not one.way]  # the first file, the second file, and cameras of the rows
OTHERWISE = next(one for one in LISTED if one.way)  # the first file, read in another way
ROWS = CAMERAS[-1]
DAMAGED = SceneError(FIRST, "expected cameras, found none", "export them again")
OTHER_PHOTOS = SceneError(IMAGES, "other photos")


def stored(*names: str) -> CameraFile:
    """Return cameras of these names, all in one place."""
    count = len(names)
    poses, K, sides = np.tile(np.eye(4), (count, 1, 1)), np.tile(np.eye(3), (count, 1, 1)), np.ones(count, int)
    return CameraFile(str(FIRST), poses, K, sides, sides, names, "transforms.json")


ESTIMATED_CAMERAS = replace(stored("0.png", "1.png", "2.png", "3.png"), source=ESTIMATED)
SEES_LITTLE, SEES_HALF = CameraCheck(0.03, np.nan, ok=False), CameraCheck(0.5, np.nan, ok=True)


def fits(candidate: Candidate = CAMERAS[0], **facts: Any) -> Evidence:
    """Return evidence on cameras of three views that can be read."""
    usual = {"names": ("0.png", "1.png", "2.png"), "num_views": 3, "stored": stored("0.png", "1.png", "2.png")}
    return Evidence(candidate, **(usual | facts))


def fails(candidate: Candidate = CAMERAS[0], error: SceneError = DAMAGED, **facts: Any) -> Evidence:
    return Evidence(candidate, error, **facts)


def with_files(evidence: Evidence, **changes: Any) -> Evidence:
    """Return evidence on a candidate of a scene with other files."""
    candidate = replace(evidence.candidate, files=replace(evidence.files, **changes))
    return replace(evidence, candidate=candidate)


def test_files_are_tried_in_order_and_the_rows_last() -> None:
    assert [one.files.cameras for one in CAMERAS] == [FIRST, SECOND, None]
    assert [one.replaces_files for one in CAMERAS] == [False, False, True]
    assert [one.files.cameras for one in LISTED] == [FIRST, SECOND] * (1 + len(WAYS)) + [None]
    assert len(list_candidates(FILES, keeps_cameras=True)) == len(LISTED) - 1
    assert len(list_candidates(replace(FILES, cameras=None, others=()))) == 1  # its cameras are those of the rows
    below = replace(FILES, cameras=None, below=True, others=(FOLDER / "a/sparse", FOLDER / "b/sparse"))
    assert [one.files.cameras for one in list_candidates(below)] == [None]  # several folders may be several scenes


@pytest.mark.parametrize(
    ("facts", "files", "expected"),
    [
        ({"has_photos": True, "are_pixels": True}, {}, True),
        ({"has_photos": True, "photos_explain": True}, {}, True),
        ({"has_photos": True}, {}, False),
        ({"has_photos": True}, {"others": ()}, True),
        ({}, {}, True),
        ({"notes": ("a note",)}, {}, True),
        ({"notes": (Doubt("a doubt"),)}, {}, False),
        ({"notes": (Doubt("a doubt"),), "are_pixels": True}, {}, True),
        ({"are_pixels": True}, {"below": True}, False),
        ({"are_pixels": True, "error": DAMAGED}, {}, False),
    ],
)
def test_pixels_or_photos_make_cameras_certain(facts: dict[str, Any], files: dict[str, Any], expected: bool) -> None:
    evidence = with_files(fits(**facts), **files)
    assert certainly_fits(evidence) is expected
    assert is_needed(CAMERAS[1], [evidence]) is not expected


def test_cameras_are_read_in_the_way_in_which_their_photos_fit_better() -> None:
    first = fits(CAMERAS[0], has_photos=True, photos_explain=True)
    doubted = replace(first, better_ways=(OTHERWISE.way,))
    otherwise = fits(OTHERWISE, has_photos=True)
    assert not is_needed(OTHERWISE, [first])
    assert is_needed(OTHERWISE, [doubted])
    assert not is_needed(CAMERAS[1], [doubted])
    assert choose([doubted, otherwise]) is otherwise
    assert choose([doubted, fails(OTHERWISE)]) is doubted
    assert choose([first, otherwise]) is first
    load: Any = object()
    assert release_spare(replace(otherwise, load=load), [doubted]).load is load
    choices = give_reasons(LISTED, [doubted, otherwise], otherwise)
    assert OTHERWISE.way in choices[0].reason
    assert [OTHERWISE.way in str(one.path) for one in choices if one.chosen and one.kind == "cameras"] == [True]


def test_the_first_certain_cameras_precede_the_first_that_fit() -> None:
    unsure = fits(has_photos=True)
    certain = fits(CAMERAS[1], has_photos=True, photos_explain=True)
    assert choose([unsure, certain]) is certain
    assert choose([unsure, fits(CAMERAS[1], has_photos=True)]) is unsure
    chosen = choose([fails(), fits(CAMERAS[1], has_photos=True)])
    assert chosen is not None
    assert chosen.files.cameras == SECOND
    assert choose([fails(), fails(CAMERAS[1])]) is None
    assert find_cause([unsure, fails()]) is DAMAGED


def test_only_scenes_that_may_be_chosen_are_kept() -> None:
    load: Any = object()
    unsure, certain = fits(has_photos=True, load=load), fits(has_photos=True, are_pixels=True, load=load)
    assert release_spare(unsure, []).load is load
    assert release_spare(unsure, [fails()]).load is load
    assert release_spare(unsure, [unsure]).load is None
    assert release_spare(certain, [unsure]).load is load
    assert release_spare(replace(unsure, candidate=ROWS), [unsure]).load is load  # may replace the cameras of a file


@pytest.mark.parametrize(
    ("evidence", "files", "expected"),
    [
        (fits(), {}, False),
        (fits(own_views=3), {}, False),
        (fits(own_views=4), {}, True),
        (fits(own_views=4), {"named": frozenset({"cameras"})}, True),
        (fails(), {}, True),
        (fails(), {"named": frozenset({"cameras"})}, False),
        (fails(), {"named": frozenset({"images"})}, True),
        (fails(error=OTHER_PHOTOS), {"named": frozenset({"images"})}, False),
        (fails(error=OTHER_PHOTOS), {}, True),
    ],
)
def test_rows_give_cameras_where_files_do_not(evidence: Evidence, files: dict[str, Any], expected: bool) -> None:
    assert is_needed(ROWS, [with_files(evidence, **files)]) is expected


@pytest.mark.parametrize("cameras", [None, FILES.ply])
def test_cameras_of_the_rows_and_in_the_file_have_no_substitute(cameras: Path | None) -> None:
    assert not any(one.replaces_files for one in list_candidates(replace(FILES, cameras=cameras)))


def test_cameras_that_do_not_fit_are_left_out_for_those_of_the_rows() -> None:
    rows = fits(ROWS, notes=(Note("no photo is used", "unused photos"), "a note"))
    chosen = choose([fails(), rows])
    assert chosen is not None
    assert chosen.files.cameras is None
    assert isinstance(chosen.notes[0], Doubt)
    assert noted(chosen.notes[:1], str(FIRST), str(IMAGES), "are left out", DAMAGED.problem, DAMAGED.remedy)
    assert chosen.notes[1:] == ("a note",)
    assert choose([fails(), replace(rows, error=DAMAGED)]) is None


def test_rows_of_more_views_than_cameras_name_the_views_that_lack_one() -> None:
    few = fits(num_views=2, names=("0.png", "1.png"), stored=stored("0.png", "1.png"), own_views=3)
    rows = fits(ROWS, notes=(Note("estimated", "estimated cameras"),))
    chosen = choose([few, rows])
    assert chosen is not None
    assert noted(chosen.notes, "1 of 3 views has no camera", str(FIRST), "2.png")
    assert len(chosen.notes) == 1
    unknown = replace(few, stored=None)
    assert choose([unknown, rows]) is unknown


def test_photos_that_the_caller_named_are_not_given_up() -> None:
    named = frozenset({"images"})
    best = with_files(fits(num_views=2, own_views=3, has_photos=True, stored=stored("0.png", "1.png")), named=named)
    rows = with_files(fits(ROWS), named=named)
    assert choose([best, rows]) is best
    chosen = choose([best, replace(rows, has_photos=True)])
    assert chosen is not None
    assert chosen.files.cameras is None


@pytest.mark.parametrize(
    ("cause", "bare", "photos", "expected"),
    [
        (SceneError(FOLDER / "a.ply", "no views"), {}, {}, False),
        (SceneError(FOLDER / "a.ply", "no views"), {"are_pixels": True}, {}, True),
        (SceneError(FOLDER / "a.ply", "no views"), {}, {"by_names": True}, True),
        (OTHER_PHOTOS, {}, {}, True),
        (SceneError(IMAGES / "0.png", "a damaged photo"), {}, {}, True),
        (SceneError(IMAGES / "0.png", "a damaged photo"), {"error": DAMAGED}, {}, False),
    ],
)
def test_photos_are_left_out_only_beside_cameras_that_belong_to_the_scene(
    cause: SceneError, bare: dict[str, Any], photos: dict[str, Any], expected: bool
) -> None:
    views = Views(CAMERAS[0], stored("0.png"), ScenePhotos(IMAGES, named=(IMAGES / "0.png",), **photos))
    shown = fails(error=cause, photo_place=IMAGES)
    chosen = choose_photos(shown, fits(photo_place=IMAGES, **bare), views)
    assert (chosen is not shown) is expected
    assert noted(chosen.notes, f"the photos in {IMAGES} are left out", cause.problem) is expected
    assert (chosen.photo_error is cause) is expected


@pytest.mark.parametrize(
    ("error", "named", "lenses", "expected"),
    [
        (None, (), (), False),
        (DAMAGED, (), (), True),
        (DAMAGED, ("images",), (), False),
        (DAMAGED, (), ("a lens",), False),
    ],
)
def test_cameras_are_examined_alone_only_if_their_photos_may_be_left_out(
    error: SceneError | None, named: tuple[str, ...], lenses: Any, expected: bool
) -> None:
    candidate = Candidate(replace(FILES, named=frozenset(named)))
    views = Views(candidate, replace(stored("0.png"), lenses=lenses))
    assert needs_bare(Evidence(candidate, error), views) is expected


def test_named_photos_are_blamed_for_cameras_that_were_found() -> None:
    def blames(error: SceneError, *named: str) -> bool:
        candidate = Candidate(replace(FILES, named=frozenset(named)))
        return blames_photos(fails(candidate, error, stored=stored("0.png")), Views(candidate, stored("0.png")))

    assert blames(DAMAGED, "images")
    assert not blames(DAMAGED)
    assert not blames(OTHER_PHOTOS, "images")
    assert not blames(DAMAGED, "images", "cameras")


def test_a_refusal_says_what_reads_the_gaussians_alone() -> None:
    named = with_files(fails(), named=frozenset({"cameras", "images"}))
    error = explain_refusal([named])
    assert (error.path, error.problem) == (DAMAGED.path, DAMAGED.problem)
    assert DAMAGED.remedy in error.remedy
    assert "--cameras none and --images none" in error.remedy
    assert explain_refusal([fails()]).remedy == DAMAGED.remedy


def test_a_refusal_is_about_the_cameras_that_see_most() -> None:
    little = SceneError(FILES.ply, "they see 3 %")
    error = explain_refusal([fails(sight=SEES_LITTLE), fails(CAMERAS[1], little, sight=SEES_HALF)])
    assert error.problem == f"{little.problem} (cameras: {SECOND}, the best of 2 camera files)"
    unmeasured = explain_refusal([fails(), fails(CAMERAS[1], little)])
    assert (unmeasured.path, unmeasured.problem) == (DAMAGED.path, DAMAGED.problem)  # the path names the candidate


def show(choices: tuple[Choice, ...]) -> list[tuple[str, str, bool, str]]:
    return [(one.kind, one.path, one.chosen, one.reason) for one in choices]


def test_every_candidate_has_a_reason_and_an_option() -> None:
    near = fits(CAMERAS[1], are_pixels=True, share_near=0.998, has_photos=True, num_shown=2, photo_place=IMAGES)
    choices = give_reasons(CAMERAS, [fails(sight=SEES_LITTLE), near], near)
    assert show(choices) == [
        ("cameras", "transforms.json", False, "see 3 % of the Gaussians"),
        ("cameras", "sparse/0", True, "99.8 % of the Gaussians lie near their pixels"),
        ("photos", "images", True, "show 2 of 3 views"),
    ]
    assert [one.option for one in choices] == ["", f"--cameras {SECOND}", f"--images {IMAGES}"]
    assert candidate_lines([asdict(one) for one in choices]) == [
        "cameras  transforms.json  left out  see 3 % of the Gaussians",
        "cameras  sparse/0         chosen    99.8 % of the Gaussians lie near their pixels",
        "photos   images           chosen    show 2 of 3 views",
    ]


@pytest.mark.parametrize(
    ("tried", "chosen", "expected"),
    [
        ([fits(sight=SEES_HALF)], 0, [(True, "see 50 % of the Gaussians"), (False, "not examined, since others fit")]),
        ([fits()], 0, [(True, "photos have the colours of the Gaussians in their views"),
                       (False, "not examined, since others fit")]),
        ([fails(), fails(CAMERAS[1])], None, [(False, DAMAGED.problem), (False, DAMAGED.problem)]),
        ([fits(sight=SEES_HALF), fits(CAMERAS[1], are_pixels=True, share_near=1.0)], 1,
         [(False, "see 50 % of the Gaussians, but no photo shows that they fit"),
          (True, "100.0 % of the Gaussians lie near their pixels")]),
        ([fits(own_views=4, sight=SEES_HALF), fits(ROWS, num_views=4, share_near=1.0, stored=ESTIMATED_CAMERAS)], 1,
         [(False, "see 50 % of the Gaussians, but they are 3, and the Gaussians form 4 views"),
          (False, "not examined, since others fit"),
          (True, "the Gaussians form 4 views: 100.0 % of the Gaussians lie near their pixels")]),
        ([fails(), fails(CAMERAS[1]), Evidence(ROWS)], 2,
         [(False, DAMAGED.problem), (False, DAMAGED.problem), (False, "the Gaussians form no grid of pixels")]),
    ],
)  # fmt: skip
def test_cameras_have_a_reason(tried: list[Evidence], chosen: int | None, expected: list[tuple[bool, str]]) -> None:
    choices = give_reasons(CAMERAS, tried, None if chosen is None else tried[chosen])
    assert [(one.chosen, one.reason) for one in choices if one.kind == "cameras"] == expected


def test_photos_that_the_caller_named_are_the_reason_of_cameras_and_rows() -> None:
    candidates = list_candidates(replace(FILES, named=frozenset({"images"})))
    first = fails(candidates[0], OTHER_PHOTOS, photo_place=IMAGES)
    rows = fits(candidates[-1], num_views=4, share_near=1.0, stored=ESTIMATED_CAMERAS)
    reasons = [one.reason for one in give_reasons(candidates, [first, rows], None) if one.kind == "cameras"]
    assert reasons[0] == "the photos that were named do not show their views"
    assert reasons[-1].endswith("but the photos that were named do not show them")


def test_a_state_without_cameras_has_no_candidate_of_rows() -> None:
    candidates = list_candidates(SceneFiles(FOLDER / "a.gsm", None, None))
    assert give_reasons(candidates, [Evidence(candidates[0])], None) == ()


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        ({"photo_error": MismatchError(IMAGES, "no photo")}, [("images", False, "show none of the views")]),
        ({"photo_error": SceneError(IMAGES, "damaged")}, [("images", False, "damaged")]),
        ({}, [("images", False, "no cameras say which views they show")]),
        ({"photo_place": FOLDER / "DCIM", "has_photos": True, "num_shown": 3},
         [("DCIM", True, "show 3 of 3 views"), ("images", False, "another folder has the names of more views")]),
    ],
)  # fmt: skip
def test_photos_have_a_reason(facts: dict[str, Any], expected: list[tuple[str, bool, str]]) -> None:
    one = fits(**({"photo_place": IMAGES} | facts))
    choices = give_reasons(CAMERAS, [one], one)
    assert [(photos.path, photos.chosen, photos.reason) for photos in choices if photos.kind == "photos"] == expected


def test_files_that_are_not_searched_are_named_with_their_option() -> None:
    a, b = FOLDER / "a/sparse", FOLDER / "b/sparse"
    outside = ("images", FOLDER.parent / "photos")
    candidates = list_candidates(replace(FILES, cameras=None, below=True, others=(a, b), above=(outside,)))
    rows = Evidence(candidates[0])
    choices = give_reasons(candidates, [rows], rows)
    assert [(one.kind, one.option) for one in choices] == [
        ("cameras", ""), ("cameras", f"--cameras {a}"), ("cameras", f"--cameras {b}"),
        ("photos", "--images photos"),
    ]  # fmt: skip
    assert not any(one.chosen for one in choices)
