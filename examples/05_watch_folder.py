"""Compact every scene that a model writes into a folder, as soon as the scene is complete; Ctrl-C ends the program.

python examples/05_watch_folder.py exports/ small/ --still 5

A scene is a folder or a .ply in the watched folder. It counts as complete when none of its files has changed for some
seconds. ``gsmerge batch`` compacts it. That command skips scenes that are done, also after a restart, and a scene that
fails does not end it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path


def last_change(scene: Path) -> float:
    """Return the time of the last change of a scene's files; infinity if it has no .ply yet."""
    files = [path for path in (scene.rglob("*") if scene.is_dir() else [scene]) if path.is_file()]
    if not any(path.suffix == ".ply" for path in files):
        return float("inf")
    return max(path.stat().st_mtime for path in files)


def main() -> None:
    """Parse the command line, and look for new scenes again and again."""
    parser = argparse.ArgumentParser(description="Compact scenes as they come.")
    parser.add_argument("folder", type=Path, help="where the model writes")
    parser.add_argument("output", type=Path, help="folder of the results")
    parser.add_argument("--still", type=float, default=5, help="seconds without a change until a scene is complete")
    parser.add_argument("--once", action="store_true", help="end when all complete scenes are done")
    args = parser.parse_args()
    done: dict[Path, float] = {}  # finished scenes, with the time of their last change
    code = 0  # exit code of the last call that failed
    while True:
        changes = {scene: last_change(scene) for scene in sorted(args.folder.iterdir())}
        complete = {scene: t for scene, t in changes.items() if t + args.still < time.time() and done.get(scene) != t}
        if complete:
            call = [sys.executable, "-m", "gsmerge", "batch", *map(str, complete), "-o", str(args.output)]
            code = subprocess.run(call, check=False).returncode or code
            done.update(complete)
        elif args.once:
            sys.exit(code)
        time.sleep(1)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
