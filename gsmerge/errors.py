"""Exceptions for problems that a user can fix, each with its exit code.

Invalid arguments of the Python API raise ``ValueError``. Problems with files and their content raise one of these
exceptions; the command line prints the message of an exception as one line.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from copy import copy
from os import PathLike
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

if TYPE_CHECKING:
    from typing_extensions import Self

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class GsmergeError(Exception):
    """Base of all errors that a user can fix; ``exit_code`` is the exit code of the command line.

    Example:
        >>> try:
        ...     gsmerge.read_scene("nowhere")
        ... except gsmerge.GsmergeError as error:
        ...     print(error.exit_code)
        3
    """

    exit_code = 1


class UsageError(GsmergeError, ValueError):
    """Options that do not fit together, or do not fit this scene."""

    exit_code = 2


class SceneError(GsmergeError):
    """A file, folder or argument without the expected content: ``problem`` and ``remedy`` without full stops.

    Example:
        >>> try:
        ...     gsmerge.read_ply("nowhere.ply")
        ... except gsmerge.SceneError as error:
        ...     print(error.path)
        nowhere.ply
    """

    exit_code = 3

    def __init__(self, path: str | PathLike[str], problem: str, remedy: str = "") -> None:
        # Messages of libraries may have several lines. Views without names are called "view 0" and so on, so "view
        # NAME" in a message has the word "view" twice
        problem = " ".join(problem.split()).replace("view view ", "view ")
        self.path = str(path)
        self.problem = problem
        self.remedy = remedy
        # what was tried before a scene was refused, see :class:`gsmerge.reading.choice.Choice`
        self.candidates: tuple[Any, ...] = ()
        super().__init__(f"{self.path}: {problem}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type[SceneError], tuple[str, str, str], dict[str, object]]:
        """Pickle the arguments and all attributes, so that processes can send this error to each other."""
        return type(self), (self.path, self.problem, self.remedy), vars(self)


def attempt(
    call: Callable[Arguments, Result], *arguments: Arguments.args, **named: Arguments.kwargs
) -> Result | SceneError:
    """Return what a call returns, or the SceneError that it raises."""
    try:
        return call(*arguments, **named)
    except SceneError as error:
        return copy(error)  # without its traceback, which keeps arrays


class DoubtWarning(UserWarning):
    """Warning of a doubtful result: worse than its input, below its target, or of files that do not fit together.

    Example:
        >>> import warnings
        >>> warnings.simplefilter("error", gsmerge.DoubtWarning)  # raise an error for each doubt
    """


def count_words(number: int, noun: str, rest: str = "") -> str:
    """Return a number with its noun, in the plural unless the number is 1, and the ``rest`` of the phrase.

    Example:
        >>> count_words(1, "row"), count_words(1200, "row", "set aside")
        ('1 row', '1,200 rows set aside')
    """
    if number != 1:
        noun += "es" if noun.endswith("ch") else "s"
    return f"{number:,} {noun} {rest}".rstrip()


class Note(str):
    """A note for the user, and what it is ``about``: a topic such as "columns", and the ``names`` of these columns.

    Code chooses among notes by what they are about, and never by their words. Notes among which no code chooses are
    plain strings.
    """

    about: str
    names: tuple[str, ...]

    def __new__(cls, text: str, about: str = "", names: Iterable[str] = ()) -> Self:
        """Return the text with its topic and names."""
        note = super().__new__(cls, text)
        note.about, note.names = about, tuple(names)
        return note


class Doubt(Note):
    """A note for the user that the result may be poor or wrong.

    Commands show a doubt as a warning, and fail with ``--strict``; Python gives a :class:`gsmerge.DoubtWarning`.
    """


USUAL = "usual"  # topic of notes on what is changed in most scenes


def list_doubts(notes: Iterable[str]) -> list[str]:
    """Return the notes that are doubts."""
    return [note for note in notes if isinstance(note, Doubt)]


def split_notes(notes: Iterable[str], about: str) -> tuple[list[Note], list[str]]:
    """Split notes into those about a topic, and all others."""
    chosen = [note for note in notes if isinstance(note, Note) and note.about == about]
    return chosen, [note for note in notes if not (isinstance(note, Note) and note.about == about)]


def name_notes(name: object, notes: Iterable[str]) -> list[str]:
    """Put a name before each note, such as that of the file that the note is about; doubts stay doubts."""
    return [
        type(note)(f"{name}: {note}", note.about, note.names) if isinstance(note, Note) else f"{name}: {note}"
        for note in notes
    ]


class TargetError(GsmergeError):
    """A requested quality or size could not be reached."""

    exit_code = 4


class BatchError(GsmergeError):
    """At least one scene of a batch failed."""

    exit_code = 5


DAMAGED_OPENCV = (
    "expected a complete OpenCV, found the module cv2 without its parts, which happens when one of several opencv"
    " packages is uninstalled; run pip install --no-deps --force-reinstall opencv-contrib-python-headless"
)


def is_opencv_damaged(error: BaseException) -> bool:
    """Return whether an error says that the folder ``cv2``, into which several packages install, is incomplete."""
    return isinstance(error, AttributeError | ImportError) and "cv2" in f"{error} {getattr(error, 'path', '')}"


TORCH_INSTALL = 'pip install "torch>=2.4,<3" --extra-index-url https://download.pytorch.org/whl/cpu'
NO_TORCH = f"this needs torch, which is not installed; this installs it for CPUs: {TORCH_INSTALL}"


def is_torch_missing(error: BaseException) -> bool:
    """Return whether an error says that the package torch is not installed."""
    return isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == "torch"


@contextmanager
def refuse_without_torch() -> Iterator[None]:
    """Raise UsageError, with the command that installs torch, if the block fails because torch is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if is_torch_missing(error):
            raise UsageError(NO_TORCH) from error
        raise


OUT_OF_MEMORY = "out of memory; use a smaller scene, or fewer threads or jobs"  # not all commands have these as options
_MEMORY_ERRORS = ("failed to map segment", "annot allocate memory", "can't allocate memory", "can't start new thread",
              "Insufficient memory")  # the last one comes from OpenCV  # fmt: skip


def is_out_of_memory(error: BaseException | None) -> bool:
    """Return whether an error, or one of its causes, reports a lack of memory."""
    while error is not None:
        if isinstance(error, MemoryError) or any(text in str(error) for text in _MEMORY_ERRORS):
            return True
        error = error.__cause__ or error.__context__
    return False


def file_problem(error: BaseException, unnamed: str = "a file") -> str | None:
    """Describe an error of the file system in one line; None for any other error.

    ``unnamed``: words for the file if the error does not name it.
    """
    if not isinstance(error, OSError) or error.strerror is None:
        return None
    if error.filename is not None:
        return f"{error.filename}: cannot be read or written ({error.strerror})"
    is_of_disk = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
    return (
        f"{unnamed} could not be written ({error.strerror}); free some space, or write elsewhere"
        if is_of_disk
        else None
    )


def error_line(error: BaseException, unnamed: str = "a file") -> str:
    """Describe an error in one line.

    ``unnamed``: words for the file of an error that does not name it, see :func:`file_problem`.
    """
    if is_out_of_memory(error):
        return OUT_OF_MEMORY
    if is_opencv_damaged(error):
        return DAMAGED_OPENCV
    if is_torch_missing(error):
        return NO_TORCH
    if not isinstance(error, GsmergeError) and (problem := file_problem(error, unnamed)) is not None:
        return problem
    text = str(error) if isinstance(error, GsmergeError) else f"{type(error).__name__}: {error}"
    return " ".join(text.split())
