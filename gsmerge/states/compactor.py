"""State and settings in one object: views in batches, Gaussians at any time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

from gsmerge.plan import resolve_fit
from gsmerge.runtime.record import Progress
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.extend import merge_settings
from gsmerge.states.decode import OF_MIXED, decode_state
from gsmerge.states.extend import BatchReport, extend
from gsmerge.states.state import State
from gsmerge.states.state_file import load_state, save_state
from gsmerge.types import Gaussians, Scene


class Compactor:
    """Compact views that arrive in batches of any size (paper section 4.5, "Online reconstruction").

    After one batch ``decode(k=2, fit="none")`` equals ``compact(scene, k=2, fit="none", poses="fixed",
    exposure="fixed")`` bit for bit, unless a budget or the size of the input limits the number of superpixels, or
    Gaussians that no view sees are kept.

    Args:
        **settings: Settings by name, those of :class:`gsmerge.CompactOptions` and of
            :class:`gsmerge.settings.extend.ExtendOptions`: ``Compactor(superpixels="3%", max_k=2)``.

    Raises:
        ValueError: If a setting is unknown or out of range.

    Example:
        >>> compactor = gsmerge.Compactor(superpixels="3%")
        >>> outcome = compactor.extend(gsmerge.read_scene("demo"))
        >>> len(compactor.decode(k=1, fit="none")) < 500
        True
    """

    def __init__(self, **settings: Any) -> None:
        self._options, self._extend_options = merge_settings(settings)
        self._state: State | None = None

    @classmethod
    def load(cls, path: str | PathLike[str], **settings: Any) -> Compactor:
        """Load a saved state, with its settings unless others are given.

        Raises:
            SceneError: If the file cannot be read or is damaged.
            ValueError: If a setting is unknown or out of range.
        """
        state = load_state(path)
        compactor = cls.__new__(cls)
        compactor._state = state
        compactor._options, compactor._extend_options = merge_settings(settings, state.about["options"])
        return compactor

    def __repr__(self) -> str:
        num_views = 0 if self._state is None else len(self._state.cameras)
        return f"Compactor({len(self):,} Feature Gaussians of {num_views:,} views)"

    def __len__(self) -> int:
        """Return the number of groups so far."""
        return 0 if self._state is None else len(self._state)

    @property
    def state(self) -> State | None:
        """State after all batches so far; None before the first."""
        return self._state

    @property
    def batches(self) -> Sequence[Mapping[str, Any]]:
        """Report of every batch so far; see :class:`gsmerge.states.extend.BatchReport`."""
        return () if self._state is None else tuple(self._state.about["batches"])

    def extend(self, scene: Scene, *, progress: Progress | None = None) -> BatchReport:
        """Add a batch of views, see :func:`gsmerge.states.extend.extend`."""
        self._state, report = extend(self._state, scene, self._options, self._extend_options, progress=progress)
        return report

    def decode(
        self,
        *,
        k: int | str | None = None,
        budget: int | str | None = None,
        progress: Progress | None = None,
        **fit: Any,
    ) -> Gaussians:
        """Decode the current state into Gaussians; see :func:`gsmerge.states.decode.decode_state`.

        Args:
            k: Gaussians of each group, 1 to ``max_k``, or ``"mixed"``; None: that of the settings.
            budget: Gaussians in all instead: a number from one for each group on, a share of the input as "2%", a size
                as "5MB", or ``"auto"``: up to the knee of the superpixels' distortion, where they help most.
            progress: See :func:`gsmerge.compact`.
            **fit: Settings of the fit to the stored photos, such as ``fit="none"`` or ``effort="fast"``, and
                ``k_low``, ``k_high`` and ``k_rule`` of mixed K.

        Raises:
            ValueError: If there was no batch yet, or K or the budget is out of range.
        """
        if self._state is None:
            raise ValueError("expected at least one batch of views before decoding, got none")
        mixed = {name: fit.pop(name) for name in OF_MIXED if name in fit}
        options = resolve_fit(CompactOptions().with_settings(fit)) if fit else None
        seed, threads = self._options.seed, self._options.threads
        return decode_state(
            self._state, k=k, budget=budget, mixed=mixed, options=options, seed=seed, threads=threads, progress=progress
        ).gaussians

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> None:
        """Write the state to a file; see :func:`gsmerge.states.state_file.save_state`.

        Raises:
            ValueError: If there was no batch yet.
            SceneError: If the file exists or cannot be written.
        """
        if self._state is None:
            raise ValueError("expected at least one batch of views before saving, got none")
        save_state(path, self._state, overwrite=overwrite)
