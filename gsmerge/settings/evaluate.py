"""Declare the settings of an evaluation against photos."""

from __future__ import annotations

from gsmerge.frozen import dataclass
from gsmerge.runtime import MOST_THREADS
from gsmerge.settings.setting import Settings, setting

NETS = ("vgg", "alex")


@dataclass(frozen=True)
class EvaluateOptions(Settings):
    """Settings of :func:`gsmerge.evaluate`.

    Example:
        >>> gsmerge.EvaluateOptions(lpips=(), photo_side=476).photo_side
        476
    """

    lpips: tuple[str, ...] = setting(("alex",), "Networks of LPIPS, a perceptual difference of pictures: alex takes a "
        "tenth of the time of vgg, which papers use.", choices=NETS)  # fmt: skip
    lpips_views: int | None = setting(4, "Largest number of views of each split to measure LPIPS on; null: all.",
        "The views are evenly spread.", least=1)  # fmt: skip
    context: bool = setting(True, "Also measure on the input views.")
    own: bool = setting(True, "Also measure the input scene itself.")
    threads: int | None = setting(
        None, "Number of threads; the figures do not depend on it.", least=1, most=MOST_THREADS
    )
    photo_side: int = setting(0, "Longest side, in pixels, to which larger photos and their cameras are resized; the "
        "paper measures at 476.",
        "0: photos keep their size.", least=0, unit="pixels")  # fmt: skip
    antialiased: bool | None = setting(None, "Lower the opacity of small Gaussians to offset the low-pass filter, "
        "which enlarges them, as some viewers do (Mip-Splatting); null: each file is drawn as its mark says.",
        "See `antialiased` of `gsmerge.render`.")  # fmt: skip
    fog: bool = setting(True, "Also measure fog, veils, holes and spikes of the results. This draws the scene's "
        "Gaussians 24 more times.")  # fmt: skip
