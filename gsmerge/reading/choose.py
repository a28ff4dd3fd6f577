"""Choose the cameras and photos of a scene by evidence, and say why.

The functions read no files. They see only what :mod:`gsmerge.reading.examine` found out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gsmerge.errors import Doubt, SceneError, list_doubts, split_notes
from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.image_names import IMAGE_SUFFIXES
from gsmerge.reading.alignment import ESTIMATED, CameraCheck, UnseenError
from gsmerge.reading.candidates import SHOWN_BY_PHOTOS, Candidate, Views
from gsmerge.reading.choice import ESTIMATED_CAMERAS, Choice, make_choice
from gsmerge.reading.loaded import Loaded
from gsmerge.reading.photos.scene_photos import MismatchError, describe_missing
from gsmerge.reading.scene_files import KINDS, SceneFiles
from gsmerge.settings.reading import NONE
from gsmerge.types import Scene


@dataclass(frozen=True, eq=False)
class Evidence:
    """What shows whether a candidate, which is cameras with or without photos, belongs to the Gaussians."""

    candidate: Candidate
    error: SceneError | None = None  # why it does not belong to the Gaussians, or cannot be read; None if it may belong
    stored: CameraFile | None = None  # its cameras as stored, without images; None if they cannot be read
    are_pixels: bool = False  # True: the rows are the pixels of its views
    share_near: float | None = None  # of the Gaussians, near their pixels; None unless rows are its pixels
    sight: CameraCheck | None = None  # what its cameras see; None if it was not measured
    num_views: int = 0
    names: tuple[str, ...] = ()  # of its views
    own_views: int = 0  # number of views that the rows form, if they are not the pixels of its views; else 0
    photo_place: Path | None = None  # folder or file of its photos; None without any
    has_photos: bool = False
    num_shown: int = 0  # number of its views that a photo shows
    better_ways: tuple[str, ...] = ()  # keys of ``WAYS`` in which photos fit the views better than as the file says
    photos_explain: bool = False  # True: the photos that names propose explain what most views show
    photo_error: SceneError | None = None  # why its photos are left out
    notes: tuple[str, ...] = ()  # of the scene with the candidate
    load: Loaded | None = None  # the scene with the candidate; None if it cannot be chosen

    @property
    def files(self) -> SceneFiles:
        """The scene's files with these cameras."""
        return self.candidate.files

    @property
    def scene(self) -> Scene:
        """The scene with the candidate, which is there if there is no error and no other candidate is chosen."""
        assert self.load is not None, "a candidate without an error has a scene"
        return self.load.scene


def is_needed(candidate: Candidate, tried: Sequence[Evidence]) -> bool:
    """Return whether a candidate has to be examined, after those that were ``tried``.

    Camera files are examined until one certainly fits, and then in the ways in which its photos fit better. Cameras of
    the rows are estimated if no file fits, or if rows form more views than the chosen file has cameras. Cameras that
    the caller named are not replaced if they do not fit, and neither are cameras beside photos that the caller named
    and that are to blame.
    """
    if not candidate.replaces_files:
        if candidate.way in SHOWN_BY_PHOTOS:
            same = [one for one in tried if one.files.cameras == candidate.files.cameras]
            return any(
                is_better_read(one, candidate) or isinstance(one.error, MismatchError | UnseenError) for one in same
            )
        return not any(map(certainly_fits, tried))
    files = tried[0].files
    best = choose(tried)
    if best is not None:
        return best.own_views > best.num_views
    photos_are_to_blame = False
    if "images" in files.named:
        photos_are_to_blame = Path(find_cause(tried).path).is_relative_to(files.images or files.ply)
    return "cameras" not in files.named and not photos_are_to_blame


def certainly_fits(evidence: Evidence) -> bool:
    """Return whether a candidate certainly belongs to the Gaussians, so that no other has to be examined.

    - With photos, it does if rows are its pixels, if the photos show its views, or if there are no other cameras.
    - Without photos, it does if no other cameras lie in folders below the scene, and if rows are its pixels or the
      scene has no doubts. Cameras in folders below may be those of another scene, which only photos can show.
    """
    files = evidence.files
    if evidence.error is not None:
        return False
    if evidence.has_photos:
        return evidence.are_pixels or evidence.photos_explain or not files.others
    return not files.below and (evidence.are_pixels or not list_doubts(evidence.notes))


def is_better_read(evidence: Evidence, other: Candidate) -> bool:
    """Return whether photos fit the views better if the cameras are read in the way of another candidate."""
    return other.way in evidence.better_ways and other.files.cameras == evidence.files.cameras


def choose(tried: Sequence[Evidence]) -> Evidence | None:
    """Choose the first cameras that certainly fit, or else the first that may fit; None if none does.

    If their photos fit better in another way of reading the file, it is read in this way.

    Cameras of the rows, if they were needed, are chosen if no camera file fits, or if the file lacks a camera of some
    view; a note says so. They are not chosen if photos that the caller named cannot be used with them.
    """
    files = tried[0].files
    fitting = [one for one in tried if one.error is None and not one.candidate.replaces_files]
    best = next(filter(certainly_fits, fitting), fitting[0] if fitting else None)
    if best is not None:
        best = next((one for one in fitting if is_better_read(best, one.candidate)), best)
    rows = tried[-1] if tried[-1].candidate.replaces_files else None
    if rows is None or rows.error is not None or lacks_named_photos(rows):
        return best
    missing = describe_missing(rows.names, (best or tried[0]).stored, is_right=best is not None)
    if missing is not None:
        return replace(rows, notes=(missing, *split_notes(rows.notes, "estimated cameras")[1]))
    return best or leave_out(rows, files, [str(files.cameras)], find_cause(tried))


def lacks_named_photos(evidence: Evidence) -> bool:
    """Return whether photos that the caller named cannot be used with a candidate."""
    files = evidence.files
    return not evidence.has_photos and "images" in files.named and files.images is not None


def release_spare(evidence: Evidence, earlier: Sequence[Evidence]) -> Evidence:
    """Return evidence without its scene, whose arrays take memory, if an earlier camera file is chosen before it."""
    is_better_way = any(is_better_read(one, evidence.candidate) for one in earlier)
    may_be_chosen = evidence.candidate.replaces_files or certainly_fits(evidence) or is_better_way
    is_spare = not may_be_chosen and any(one.error is None for one in earlier)
    return replace(evidence, load=None) if is_spare else evidence


def find_cause(tried: Sequence[Evidence]) -> SceneError:
    """Return why the first of the candidates that do not fit does not fit."""
    return next(one.error for one in tried if one.error is not None)


def find_most_seen(tried: Sequence[Evidence]) -> Evidence:
    """Return the candidate whose cameras see most of the Gaussians, or the first if none was measured."""
    return max(tried, key=lambda one: -1.0 if one.sight is None else one.sight.score)


def explain_refusal(tried: Sequence[Evidence]) -> SceneError:
    """Return what spoke against the best candidate, if none is chosen, with what the user can do."""
    files = tried[0].files
    best = find_most_seen(tried)
    cause = best.error or find_cause(tried)
    cameras = best.files.cameras
    problem = cause.problem
    if len(tried) > 1 and cameras is not None and cause.path != str(cameras):
        num_files = len({one.files.cameras for one in tried if one.files.cameras is not None})
        rank = f", the best of {num_files} camera files" if num_files > 1 else ""
        problem += f" (cameras: {cameras}{rank})"
    options = [f"--{name} {NONE}" for name in ("cameras", "images") if name in files.named and getattr(files, name)]
    read_alone = f"{' and '.join(options)} reads the Gaussians alone" if options else ""
    return SceneError(cause.path, problem, "; ".join(filter(None, (cause.remedy, read_alone))))


def choose_photos(shown: Evidence, bare: Evidence, views: Views) -> Evidence:
    """Choose cameras with their photos (``shown``) or without photos (``bare``), with a doubt that says why.

    Photos that do not fit are left out if it is certain that the cameras belong to the scene: if rows are pixels of the
    cameras, if the photos cannot be read, or if they were found by the cameras' names. Cameras that merely see the
    Gaussians may still belong to another scene.
    """
    cause = shown.error
    folder = views.place
    if cause is None or bare.error is not None:
        return shown
    is_photo = Path(cause.path).suffix.lower() in IMAGE_SUFFIXES
    concerns_photos = is_photo or cause.path == str(folder) or not views.photos.named
    if not (bare.are_pixels or concerns_photos or views.photos.by_names):
        return shown
    left_out = leave_out(bare, replace(views.files, images=folder), [f"the photos in {folder or cause.path}"], cause)
    return replace(left_out, photo_error=cause)


def needs_bare(shown: Evidence, views: Views) -> bool:
    """Return whether cameras have to be examined without their photos, since these do not fit and may be left out.

    Photos that the caller named are never left out, and photos of a lens are needed to undistort what it shows.
    """
    has_lenses = views.camera_file is not None and bool(views.camera_file.lenses)
    return shown.error is not None and "images" not in views.files.named and not has_lenses


def blames_photos(shown: Evidence, views: Views) -> bool:
    """Return whether photos that the caller named are to blame for an error that is about cameras that were found."""
    is_found = "images" in views.files.named and "cameras" not in views.files.named
    is_about_cameras = shown.error is not None and shown.stored is not None and shown.error.path == shown.stored.path
    return is_found and is_about_cameras


def give_reasons(
    candidates: Sequence[Candidate], tried: Sequence[Evidence], chosen: Evidence | None
) -> tuple[Choice, ...]:
    """Say of all camera files, and of the photos of the chosen cameras, whether they were chosen and why.

    Cameras of the rows, and other ways of reading a file, are named if they were examined. If no cameras were chosen,
    the photos are those of the cameras that a refusal is about.
    """
    files = candidates[0].files
    choices = list[Choice]()
    evidence_on = {one.candidate: one for one in tried}
    for candidate in candidates:
        one = evidence_on.get(candidate)
        if one is not None and not (files.is_state and one.files.cameras is None):
            is_chosen = chosen is not None and chosen.candidate is candidate and one.num_views > 0
            reason, can_be_named = _judge(one, chosen)
            place = _name_cameras(one)
            choices.append(
                make_choice(files, "cameras", place, reason, chosen=is_chosen, can_be_named=can_be_named)
            )  # fmt: skip
        elif candidate.files.cameras is not None and not candidate.way:
            reason = "not examined, since others fit"
            choices.append(make_choice(files, "cameras", candidate.files.cameras, reason, chosen=False))
    for path in files.others if files.is_spread else ():
        reason = "several folders have cameras, which may be those of several scenes"
        choices.append(make_choice(files, "cameras", path, reason, chosen=False))
    for option, path in files.above:
        reason = "outside the scene's folder"
        choices.append(make_choice(files, KINDS.get(option, option), path, reason, chosen=False))
    return (*choices, *_judge_photos(chosen or find_most_seen(tried), files))


def _judge_photos(best: Evidence, files: SceneFiles) -> list[Choice]:
    """Say whether the photos of a candidate for the cameras are used, and why."""
    if best.photo_place is None:
        return []
    reason = f"show {best.num_shown} of {best.num_views} views"
    error = best.photo_error or best.error
    if isinstance(error, MismatchError):
        reason = "show none of the views"
    elif isinstance(error, UnseenError) and error.sight is not None:
        colors = error.sight.color_words
        reason = f"the Gaussians' {colors}" if colors else "no cameras fit that show which views they have"
    elif error is not None:
        reason = error.problem
    elif not best.has_photos:
        reason = "no cameras say which views they show"
    photos = make_choice(
        files, "photos", best.photo_place, reason, chosen=best.has_photos, can_be_named=best.has_photos
    )
    if files.images in (None, best.photo_place, best.files.cameras):
        return [photos]
    reason = "another folder has the names of more views"
    return [photos, make_choice(files, "photos", files.images, reason, chosen=False)]


def _name_cameras(one: Evidence) -> Path | str:
    """Return the path of cameras, or words for cameras without a file of their own."""
    if one.stored is not None and one.files.cameras is None and one.stored.source != ESTIMATED:
        return f"in {one.files.ply.name}"
    path = one.files.cameras or ESTIMATED_CAMERAS
    return f"{Path(path).name} read {one.candidate.way}" if one.candidate.way else path


def _judge(one: Evidence, chosen: Evidence | None) -> tuple[str, bool]:
    """Say in a few words, with the number that decided, why cameras were chosen or left out.

    Also return whether an option that names them would take them.
    """
    if one.error is not None:
        are_named = "images" in one.files.named and one.photo_place not in (None, one.files.cameras)
        if are_named and Path(one.error.path).is_relative_to(one.photo_place or ""):
            return "the photos that were named do not show their views", False
        return one.error.problem if one.sight is None else one.sight.words, False
    if one.num_views == 0:
        return "the Gaussians form no grid of pixels", False
    fact = "photos have the colours of the Gaussians in their views"
    if one.share_near is not None:
        fact = f"{100 * one.share_near:.1f} % of the Gaussians lie near their pixels"
    elif one.sight is not None:
        fact = f"see {100 * one.sight.share_seen:.0f} % of the Gaussians"
    if one.stored is not None and one.stored.source == ESTIMATED:
        fact = f"the Gaussians form {one.num_views} views: {fact}"
    if one.candidate.replaces_files and lacks_named_photos(one):
        return f"{fact}, but the photos that were named do not show them", False
    if chosen is not None and one.candidate is not chosen.candidate and chosen.candidate.replaces_files:
        return f"{fact}, but they are {one.num_views}, and the Gaussians form {chosen.num_views} views", False
    if chosen is not None and is_better_read(one, chosen.candidate):
        return f"{fact}, but the photos fit better if they are read {chosen.candidate.way}", False
    is_shown = one.photo_error is None and (one.are_pixels or one.has_photos or one.photo_place is None)
    is_chosen = chosen is None or one.candidate is chosen.candidate
    return fact if is_chosen and is_shown else f"{fact}, but no photo shows that they fit", True


def leave_out(evidence: Evidence, files: SceneFiles, left_out: Sequence[str], cause: SceneError) -> Evidence:
    """Return a candidate with a doubt which says what is left out, why, and what the user can do.

    ``left_out`` describes the files that are left out. If photos cannot be used without these files, the doubt also
    names the photos, and replaces the notes on photos.
    """
    photo_notes, notes = split_notes(evidence.notes, "unused photos")
    names = [*left_out, *([f"the photos in {files.images or files.ply.parent}"] if photo_notes else [])]
    known_paths = map(str, (files.ply, files.ply.parent, files.cameras, files.images))
    damaged_file = "" if cause.path in known_paths else f"{cause.path}: "
    option, value = ("cameras", "FILE") if names[0] == str(files.cameras) else ("images", "FOLDER")
    remedy = cause.remedy or f"pass --{option} {value}, or --{option} {NONE}"
    verb = "is" if names == [str(files.cameras)] else "are"
    doubt = f"{' and '.join(names)} {verb} left out: {damaged_file}{cause.problem}; {remedy}"
    return replace(evidence, notes=(Doubt(" ".join(doubt.split()), option), *notes))
