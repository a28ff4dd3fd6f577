"""Views in batches, Gaussians at any time: the state and its settings in one object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

from gsmerge.online.extend import BatchReport, extend
from gsmerge.online.file import load_state, save_state
from gsmerge.online.fitted import decode_stored
from gsmerge.online.options import OnlineOptions
from gsmerge.online.state import OnlineState
from gsmerge.options import CompactOptions
from gsmerge.runtime.run_log import Progress
from gsmerge.stages.fit import FitOptions
from gsmerge.types import Gaussians, PixelScene, UnalignedScene


class Compactor:
    """Compacts views that arrive in batches of any size (paper section 4.5, "Online reconstruction").

    Args:
        **settings: Settings by name, those of :class:`gsmerge.CompactOptions` and of
            :class:`gsmerge.online.options.OnlineOptions`: ``Compactor(density=0.03, max_k=2)``.

    Raises:
        ValueError: If a setting is unknown or out of range.

    Example:
        >>> compactor = Compactor()
        >>> for batch in batches:  # doctest: +SKIP
        ...     compactor.extend(batch)
        >>> gaussians = compactor.decode(k=2)  # doctest: +SKIP
    """

    def __init__(self, **settings: Any) -> None:
        self._options, self._online = settled(settings)
        self._state: OnlineState | None = None

    @classmethod
    def load(cls, path: str | PathLike[str], **settings: Any) -> Compactor:
        """One that goes on where a state was saved, with its settings unless others are given.

        Raises:
            SceneError: If the file cannot be read or is damaged.
            ValueError: If a setting is unknown or out of range.
        """
        state = load_state(path)
        compactor = cls.__new__(cls)
        compactor._state = state
        compactor._options, compactor._online = settled(settings, state)
        return compactor

    def __len__(self) -> int:
        """Groups so far."""
        return 0 if self._state is None else len(self._state)

    @property
    def state(self) -> OnlineState | None:
        """What was made of all batches so far; None before the first."""
        return self._state

    @property
    def batches(self) -> Sequence[Mapping[str, Any]]:
        """Numbers of every batch so far, see :class:`gsmerge.online.extend.BatchReport`."""
        return () if self._state is None else tuple(self._state.about["batches"])

    def extend(self, scene: PixelScene | UnalignedScene, *, progress: Progress | None = None) -> BatchReport:
        """Add a batch of views, see :func:`gsmerge.online.extend.extend`."""
        self._state, report = extend(self._state, scene, self._options, self._online, progress=progress)
        return report

    def decode(
        self,
        *,
        k: int | str | None = None,
        budget: int | str | None = None,
        progress: Progress | None = None,
        **fit: Any,
    ) -> Gaussians:
        """The Gaussians so far, see :func:`gsmerge.online.fitted.decode_stored`.

        Args:
            k: Gaussians of each group; None: as the settings have it.
            budget: Gaussians in all instead.
            progress: As of :func:`gsmerge.compact`.
            **fit: Settings of the fit to the photos that were kept, such as ``fit="none"`` or ``effort="fast"``.

        Raises:
            ValueError: If there was no batch yet, or what is asked for cannot be had.
        """
        if self._state is None:
            raise ValueError("expected at least one batch of views before decoding, got none")
        options, seed, threads = FitOptions(**fit) if fit else None, self._options.seed, self._options.threads
        return decode_stored(
            self._state, k=k, budget=budget, options=options, seed=seed, threads=threads, progress=progress
        ).gaussians

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> None:
        """Write the state, see :func:`gsmerge.online.file.save_state`.

        Raises:
            ValueError: If there was no batch yet.
            SceneError: If the file exists or cannot be written.
        """
        if self._state is None:
            raise ValueError("expected at least one batch of views before saving, got none")
        save_state(path, self._state, overwrite=overwrite)


def settled(settings: Mapping[str, Any], state: OnlineState | None = None) -> tuple[CompactOptions, OnlineOptions]:
    """All settings: as given, otherwise those that the state was made with, otherwise the defaults.

    Colours are what is fitted batch by batch, unless told otherwise; a full fit has its place when decoding.

    Raises:
        ValueError: If a setting is unknown or out of range.
    """
    names = OnlineOptions.__dataclass_fields__.keys()
    known = names | CompactOptions().to_dict().keys()
    before = {} if state is None else {n: v for n, v in state.about["options"].items() if n in known}
    merged = {"fit": "color"} | before | dict(settings)
    online = OnlineOptions(**{name: merged.pop(name) for name in names if name in merged})
    return CompactOptions().with_settings(merged), online
