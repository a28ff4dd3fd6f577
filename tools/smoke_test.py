"""Install a wheel or source archive in a fresh environment, and do the main job of the README's demo with it.

python tools/smoke_test.py dist/gsmerge-0.4.0-py3-none-manylinux_2_17_x86_64.whl -c constraints.txt

Arguments after the file are passed to pip install.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ("scene.ply", "scene.compact.ply", "preview.png")  # files that the main job writes to demo/


def main(archive: Path, options: list[str]) -> None:
    """Install, compare the version with the file's name, and run the demo but for its installation."""
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with TemporaryDirectory() as folder:
        bin_name = "Scripts" if os.name == "nt" else "bin"
        work, bin_folder = Path(folder), Path(folder, ".venv", bin_name)
        subprocess.run([sys.executable, "-m", "venv", str(work / ".venv")], env=env, check=True)
        install = [str(bin_folder / "python"), "-m", "pip", "install", "-q", *options, str(archive)]
        subprocess.run(install, env=env, check=True)
        shutil.copytree(ROOT / "examples", work / "examples")
        shutil.copy(ROOT / "tasks.py", work)

        version = subprocess.check_output([str(bin_folder / "gsmerge"), "--version"], cwd=work, env=env, text=True)
        print(version, end="", flush=True)
        expected = archive.name.removesuffix(".tar.gz").split("-")[1]
        if version.split() != ["gsmerge", expected]:
            sys.exit(f"expected version {expected}, as in {archive.name}, found {version.strip()!r}")

        subprocess.run([str(bin_folder / "python"), "tasks.py", "main-job"], cwd=work, env=env, check=True)
        missing = [name for name in RESULTS if not (work / "demo" / name).exists()]
        if missing:
            sys.exit(f"the README's main job left no {', '.join(missing)} in demo/")
    print(f"{archive.name}: installed, and the README's main job is done")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), sys.argv[2:])
