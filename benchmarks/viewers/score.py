"""Compare pictures of results in other viewers with our own, and find out where the viewers' first pictures look from.

cd benchmarks/viewers
npm install                                  # installs the viewers, but no Chromium: CHROMIUM=PATH names another one
                                             # than /usr/bin/chromium
gsmerge compact CAPTURE -o R/r.ply           # then gsmerge convert R/r.ply R/r.spz, r.sog, r.glb, r.splat,
                                             # R/lod/lod-meta.json, all with --cameras R/r.cameras.json
gsmerge render R/r.ply --cameras R/r.cameras.json -o R/own
node run.mjs R                               # --view 00010: another view; --only sog: some of the pictures
python score.py R CAPTURE

Two more files are opened if they are there: R/r2.spz, a .spz of version 2 (--set spz_version=2), and R/tileset.json,
whose scene has no place on the globe. WebGL2 runs in software, so times say nothing.

The first table has PSNR over all pixels: against our own picture, then against the photo. The second table is about the
first picture, which a viewer shows if no camera is given. Its angle and its dB compare this picture with the view from
which gsmerge lets viewers start.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np

FORMATS = ("ply", "spz", "spz 2", "sog", "glb", "splat", "lod-meta.json", "tileset.json")
PLACES = {  # where a first picture is taken from
    "file": "camera of the file or its settings",
    "default": "where the viewer stands by default",
    "box": "all of the bounding box",
}
BACKGROUND = 8  # largest level of a channel of the black background


def psnr(picture: np.ndarray, reference: np.ndarray) -> float:
    """Compute the PSNR (dB) of 8-bit pictures."""
    error = np.square(picture.astype(np.float64) - reference).mean()
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


def print_table(head: tuple[str, ...], rows: list[list[str]]) -> None:
    """Print a table in Markdown."""
    for cells in (head, ("---",) * len(head), *rows):
        print("|", " | ".join(cells), "|")
    print()


def main(folder: Path, capture: Path) -> None:
    """Print the tables of the pictures that run.mjs has taken, and notes on what viewers reported."""
    report = json.loads((folder / "results.json").read_text())
    own, middle = (
        cv2.imread(str(folder / "own" / Path(report[view]).with_suffix(".png").name)) for view in ("view", "middle")
    )
    photo = cv2.imread(str(capture / report["view"]))
    print(f"View {report['view']}: our own picture has {psnr(own, photo):.1f} dB against the photo.\n")
    table: dict[str, dict[str, str]] = {}
    first, notes = [], []
    for result in report["results"]:
        viewer, kind = f"{result['viewer']} | {result['version']}", result["format"]
        picture = None if "error" in result else cv2.imread(str(folder / result["picture"]))
        filled = 0.0 if picture is None else (picture.max(axis=2) > BACKGROUND).mean()
        if result["look"] == "photo":
            cell = f"{psnr(picture, own):.1f}; {psnr(picture, photo):.1f}" if filled else "no"
            table.setdefault(viewer, {})[kind] = cell
        elif picture is not None:
            seen = (f"{result['angle']:.0f}", f"{filled:.0%}", f"{psnr(picture, middle):.1f}")
            first.append([viewer, kind, PLACES[result["look"]], *seen])
        if result["messages"] or result["refused"] or not filled:
            reason = result.get("error", "" if filled else "it drew nothing")
            causes = [reason, *result["messages"], *(f"it wanted {url}" for url in result["refused"])]
            notes.append(f"- {result['name']}: {'; '.join(filter(None, causes))}")
    rows = [[name, *(row.get(kind, "") for kind in FORMATS)] for name, row in table.items()]
    print_table(("viewer", "version", *FORMATS), rows)
    print_table(("viewer", "version", "format", "first picture from", "degrees", "filled", "dB"), first)
    print("\n".join(notes))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
