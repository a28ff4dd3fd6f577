"""A state and its settings in one object: add views in batches, and make compact scenes at any time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.errors import UsageError, count_words
from gsmerge.io.formats.table import STATE_ENDING
from gsmerge.jobs.states.extend import BatchReport, extend
from gsmerge.jobs.states.features import decode_features, extend_features
from gsmerge.jobs.states.state_file import State, load_state, save_state
from gsmerge.reading.input import as_scene
from gsmerge.results.result import CompactResult
from gsmerge.run import compact
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.record import Progress
from gsmerge.settings.extend import batch_settings
from gsmerge.settings.stages import DecodeOptions
from gsmerge.types import Gaussians, Scene, StrPath

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from gsmerge.settings.keywords import BatchSettings, CompactSettings


def extend_state(
    state: State | None, scene: Scene, settings: Mapping[str, Any], *, progress: Progress | None = None
) -> tuple[State, BatchReport]:
    """Add a batch of views to a copy of ``state``, or to a new state if it is None; return the state and the report.

    ``settings`` are the settings of the batch. By default the effort is "draft", with which a scene gets no fit if each
    of its Gaussians belongs to a pixel. With ``recipe="paper"`` the first batch begins a state of Feature Gaussians,
    and later batches use the networks of this state. Raises ValueError if a setting is unknown, out of range, or
    impossible for the state or the scene. Raises SceneError if the scene seems to have another frame of coordinates
    than the state.
    """
    about = {} if state is None else dict(state.about)
    scene_before, features = (None, None) if state is None else (state.scene, state.features)
    is_paper = settings.get("recipe") == "paper"
    if is_paper and scene_before is not None:
        raise UsageError("recipe paper: expected a state that began with it, found results; begin another state")
    content: dict[str, Any] = {}
    if is_paper or features is not None:
        options = batch_settings({"recipe": "paper", "effort": "default"} | dict(settings))
        content["features"], report = extend_features(features, scene, *options, progress=progress)
    else:
        defaults = {"fit": "none"} if scene.has_own_pixels else {}  # the fit follows when the state is compacted
        options = batch_settings(defaults | dict(settings))
        content["scene"], report = extend(scene_before, scene, *options, progress=progress)
    about |= {"batches": [*about.get("batches", []), report.numbers]}
    about |= {"pictures": sorted({*about.get("pictures", []), report.pictures})}
    return State(about, **content), report


class Compactor:
    """Compact views that arrive in batches.

    Each batch is compacted when it is added. The state keeps the Gaussians of all batches, and cameras and pictures of
    at most ``max_views`` views. The method ``compact`` makes results from the Gaussians and views that the state keeps.
    With ``recipe="paper"`` the state keeps Feature Gaussians instead, which are matched and merged across batches
    (paper section 4.5, "Online reconstruction"). The method ``decode`` makes results of these Feature Gaussians with
    any K, which is the number of Gaussians made of each.

    Args:
        **settings: Settings of the batches by name, as in ``Compactor(budget="3%", max_views=16)``. These are the
            settings of :class:`gsmerge.CompactOptions` and of :class:`gsmerge.settings.extend.ExtendOptions`.

    Raises:
        ValueError: If a setting is unknown or out of range.

    Example:
        >>> compactor = gsmerge.Compactor(budget=300)
        >>> report = compactor.extend(gsmerge.read_scene("demo"))
        >>> len(compactor.compact(budget=200, effort="draft").gaussians)
        200
    """

    def __init__(self, **settings: Unpack[BatchSettings]) -> None:
        batch_settings(settings)
        self._settings = settings
        self._state: State | None = None

    @classmethod
    @check_arguments
    def load(cls, path: StrPath, **settings: Unpack[BatchSettings]) -> Compactor:
        """Load a saved state; ``settings`` apply to further batches.

        Raises:
            SceneError: If the file cannot be read or is damaged.
            ValueError: If a setting is unknown or out of range.
        """
        compactor = cls(**settings)
        compactor._state = load_state(path)
        return compactor

    def __repr__(self) -> str:
        return f"Compactor({len(self):,} Gaussians of {count_words(len(self.batches), 'batch')})"

    def __len__(self) -> int:
        """Return the number of Gaussians or Feature Gaussians so far."""
        return 0 if self._state is None else len(self._state)

    @property
    def state(self) -> State:
        """The state so far: results and views as a scene, or Feature Gaussians. ValueError before the first batch."""
        if self._state is None:
            raise ValueError("expected at least one batch of views, got none")
        return self._state

    @property
    def batches(self) -> Sequence[Mapping[str, Any]]:
        """Figures of every batch so far; see :class:`gsmerge.jobs.states.extend.BatchReport`."""
        return () if self._state is None else tuple(self._state.about["batches"])

    @check_arguments
    def extend(self, scene: Scene | StrPath, *, progress: Progress | None = None) -> BatchReport:
        """Add a batch of views in the same frame of coordinates; see :func:`gsmerge.jobs.states.extend.extend`.

        Raises:
            SceneError: If the pictures of the batch do not show the earlier Gaussians; ``other_world=True`` allows it.
        """
        self._state, report = extend_state(self._state, as_scene(scene), self._settings, progress=progress)
        return report

    @check_arguments
    def compact(self, *, progress: Progress | None = None, **settings: Unpack[CompactSettings]) -> CompactResult:
        """Compact the scene of all batches so far; see :func:`gsmerge.compact`.

        Raises:
            ValueError: If there was no batch yet, a setting is wrong, or the state has Feature Gaussians.
        """
        if self.state.scene is None:
            raise ValueError("expected a state of results, found Feature Gaussians; use decode for these")
        return compact(self.state.scene, progress=progress, **settings)

    def decode(self, **settings: Any) -> Gaussians:
        """Decode Feature Gaussians in the world frame.

        Args:
            **settings: Settings of :class:`gsmerge.settings.stages.DecodeOptions`, such as ``k``, which is the number
                of Gaussians per group, 1 to 4, or ``"mixed"``.

        Raises:
            ValueError: If there was no batch yet, a setting is wrong, or the state has results.
        """
        if self.state.features is None:
            raise ValueError('expected a state that began with recipe="paper", found results; use compact for these')
        return decode_features(self.state.features, DecodeOptions(**settings))

    @check_arguments
    def save(self, path: StrPath, *, overwrite: bool = False) -> None:
        """Write the state to a file.

        Raises:
            ValueError: If there was no batch yet, or the name does not end in ``.gsm``.
            SceneError: If the file exists or cannot be written.
        """
        if Path(path).suffix.lower() != STATE_ENDING:
            raise ValueError(f"{path}: expected a name ending in {STATE_ENDING}")
        save_state(path, self.state, overwrite=overwrite)
