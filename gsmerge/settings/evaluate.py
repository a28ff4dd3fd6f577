"""Settings of an evaluation against photos."""

from __future__ import annotations

from dataclasses import dataclass

from gsmerge.runtime import MOST_THREADS
from gsmerge.settings.setting import Settings, setting

NETS = ("vgg", "alex")
MAX_ZOOM = 16.0  # and its inverse the least: beyond, pictures have no pixels left or fill the memory


@dataclass(frozen=True)
class EvaluateOptions(Settings):
    """Settings of :func:`gsmerge.evaluate`.

    Example:
        >>> gsmerge.EvaluateOptions(lpips=(), photo_side=476).photo_side
        476
    """

    lpips: tuple[str, ...] = setting(("alex",), "Networks of LPIPS, how different pictures look: AlexNet takes a tenth "
        "of the time of VGG, which papers use.", choices=NETS)  # fmt: skip
    lpips_views: int | None = setting(4, "Measure LPIPS on at most so many views of each split; null: on all.",
        "They are evenly spread.", least=1)  # fmt: skip
    context: bool = setting(True, "Also measure the input views.")
    own: bool = setting(True, "Also measure the input itself.")
    threads: int | None = setting(
        None, "Threads; the figures do not depend on their number.", least=1, most=MOST_THREADS
    )
    photo_side: int = setting(0, "Resize larger photos and their cameras to so many pixels on the longer side; the "
        "paper measures at 476.",
        "0: they stay as they are.", least=0, unit="pixels", shown="as they are")  # fmt: skip
    zoom: tuple[float, ...] = setting((1,), "Also measure PSNR and SSIM at other sizes: rendered at these multiples of "
        "the photos' pixels per side.",
        "The photo is resized to the same size.", least=1 / MAX_ZOOM, most=MAX_ZOOM, filled=True, unique=True,
        metavar="LIST")  # fmt: skip
    antialiased: bool = setting(False, "Lower the opacity of small Gaussians by what the low-pass adds to them, as "
        "some viewers do (Mip-Splatting).",
        "See `antialiased` of `gsmerge.render`.")  # fmt: skip
    fog: bool = setting(True, "Also measure fog, veils, holes and spikes of the results, which the scene's Gaussians "
        "are drawn 24 more times for.")  # fmt: skip
