"""Every format that is written, opened by programs of others, for docs/guide/formats.md.

gsmerge compact demo -o small.ply
python benchmarks/open_formats.py small.ply opened --photos demo/images --npm packages --gsplat checkout

Programs that are not there are named and skipped: of Python gsply and pycolmap;
splat-transform (GSMERGE_SPLAT_TRANSFORM); below --npm the packages three and gltf-validator;
chromium, for Spark; --gsplat is a checkout of that repository, for the reader of its trainer. Harmonics of degree 3 are
drawn at random. Compared are all Gaussians, those in another order with the nearest: the largest errors of positions,
as a share of the scene's width, and of colours and opacities, which are 0 to 1.
"""

from __future__ import annotations

import argparse
import base64
import gzip
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path

import numpy as np
from page_tables import make_table
from plyfile import PlyData
from scipy.spatial import cKDTree

import gsmerge
from gsmerge.compaction.convert import ConvertOptions, convert_files
from gsmerge.errors import UsageError
from gsmerge.geometry import sh0_to_rgb
from gsmerge.io.cameras.colmap_model import POINTS
from gsmerge.io.cameras.viewer_cameras import viewer_cameras_path
from gsmerge.io.formats.splat_transform import find_program
from gsmerge.io.formats.table import FOLDER, PLACE
from gsmerge.pages.page import ENGINE

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "e2e"))

NAMES = ("a.ply", "a.spz", "a.sog", "a.splat", "a.glb", "web/lod-meta.json", f"{FOLDER}/{PLACE}/{POINTS}")
SPLATS = (".ply", ".spz", ".sog", ".splat", "lod-meta.json")
NODE_SCRIPT = Path(__file__).with_suffix(".mjs")
UPRIGHT = np.array([-1, -1, 1, 1, 1, 1, 1])  # what half a turn about z does to values

Values = np.ndarray  # [n,7]: positions, colours, opacities


@dataclass(frozen=True)
class Program:
    """A program that opens files with some endings: values that it reads, or what it says."""

    name: str
    version: str
    endings: tuple[str, ...]
    open: Callable[[Path], Values | str]


def ply_values(path: Path) -> Values:
    """Values of a .ply by plyfile."""
    rows = PlyData.read(str(path))["vertex"]
    means = np.stack([rows[name] for name in "xyz"], 1)
    colors = sh0_to_rgb(np.stack([rows[f"f_dc_{i}"] for i in range(3)], 1).astype(np.float64))
    return np.concatenate([means, colors, 1 / (1 + np.exp(-rows["opacity"].astype(np.float64)))[:, None]], 1)


def transformed(program: str, path: Path) -> Values:
    """Values of the .ply that splat-transform makes of a file."""
    back = path.with_name("back-by-splat-transform.ply")
    subprocess.run([program, "-q", "-w", str(path), str(back)], check=True, capture_output=True)
    return ply_values(back)


def run_node(packages: Path, library: str, path: Path) -> bytes:
    """What the script beside this one writes about a file."""
    out = path.with_name("by-node")
    subprocess.run(["node", str(NODE_SCRIPT), str(packages.resolve()), library, str(path), str(out)], check=True)
    return out.read_bytes()


def three_values(packages: Path, path: Path) -> Values:
    data = run_node(packages, "three", path)
    count = int(np.frombuffer(data, "<u4", 1)[0])
    means = np.frombuffer(data, "<f4", 3 * count, 4).reshape(-1, 3)
    colors = np.frombuffer(data, np.uint8, 4 * count, 4 + 12 * count).reshape(-1, 4) / 255
    return np.concatenate([means, colors], 1) * (UPRIGHT if path.suffix == ".glb" else 1)


def validate_glb(packages: Path, path: Path) -> str:
    issues = json.loads(run_node(packages, "gltf-validator", path))["messages"]
    other = {issue["code"] for issue in issues if "KHR_gaussian_splatting" not in str(issue)}
    return f"issues: {', '.join(sorted(other))}" if other else "no issue, but that it does not know the extension"


def colmap_values(path: Path) -> Values:
    """Values of the points of a COLMAP model by pycolmap, whose own reprojection errors have to be zero."""
    import pycolmap

    model = pycolmap.Reconstruction(str(path.parent))
    model.update_point_3d_errors()
    points = list(model.points3D.values())
    assert max(point.error for point in points if point.track.length()) < 1e-6
    means, colors = (np.array([getattr(point, name) for point in points]) for name in ("xyz", "color"))
    return np.concatenate([means, colors / 255, np.full((len(points), 1), np.nan)], 1)


def trainer_values(checkout: Path, path: Path) -> Values:
    """Values of the points of a COLMAP model as gsplat's trainer reads them, with photos beside it."""
    sys.path.insert(0, str(checkout / "examples"))
    with redirect_stdout(sys.stderr):
        parser = import_module("datasets.colmap").Parser(str(path.parents[2]), factor=1, normalize=False)
    assert all(len(parser.point_indices[name]) for name in parser.image_names)
    opacities = np.full((len(parser.points), 1), np.nan)
    return np.concatenate([parser.points, parser.points_rgb / 255, opacities], 1)


SPARK = """new Promise(async (resolve, reject) => { try {
  const fileBytes = Uint8Array.from(atob(document.getElementById("file").textContent), (c) => c.charCodeAt(0));
  const mesh = new Vendor.SplatMesh({ fileBytes, fileName: "NAME" });
  await mesh.initialized;
  const rows = [];
  mesh.forEachSplat((_, mean, scales, quat, opacity, color) => rows.push(...mean, color.r, color.g, color.b, opacity));
  resolve(rows);
} catch (error) { reject(error); } })"""


def spark_values(chromium: str, path: Path) -> Values:
    """Values of a file by Spark, of the release that `gsmerge view` has, in a browser."""
    from browser import browser

    script, _, module = gzip.decompress(files("gsmerge.pages").joinpath(ENGINE).read_bytes()).partition(b"\0")
    numbers = f"window.sparkModule = Uint8Array.fromBase64('{base64.b64encode(module).decode()}');"
    page = path.with_name("spark.html").resolve()
    data = base64.b64encode(path.read_bytes()).decode()
    page.write_text(f'<script id="file" type="text/plain">{data}</script><script>{numbers}{script.decode()}</script>')
    with tempfile.TemporaryDirectory() as profile, browser(chromium, Path(profile)) as tab:
        tab.open(page)
        rows = tab.run(SPARK.replace("NAME", path.name))
    return np.array(rows, np.float64).reshape(-1, 7)


def gsply_values(path: Path) -> Values:
    """Values of a file by gsply, which leaves opacities as logits."""
    import gsply

    read = {".spz": gsply.read_spz, ".sog": gsply.sogread}.get(path.suffix, gsply.plyread)(str(path))
    opacities = 1 / (1 + np.exp(-read.opacities.astype(np.float64)))
    return np.concatenate([read.means, sh0_to_rgb(read.sh0.reshape(-1, 3)), opacities.reshape(-1, 1)], 1)


def find_programs(args: argparse.Namespace) -> Iterator[Program]:
    """Find what is installed, and name what is not."""

    def package(name: str) -> str:
        return json.loads((args.npm / "node_modules" / name / "package.json").read_text())["version"]

    def commit() -> str:
        return subprocess.run(["git", "-C", args.gsplat, "describe", "--always", "--tags"], check=True,
                              capture_output=True, text=True).stdout.strip()  # fmt: skip

    def splat_transform() -> Program:
        program = find_program()
        about = subprocess.run([program, "--version"], check=True, capture_output=True, text=True)
        return Program(
            "splat-transform",
            (about.stdout + about.stderr).split()[1].lstrip("v"),
            SPLATS,
            partial(transformed, program),
        )

    def spark() -> Program:
        if (chromium := shutil.which("chromium")) is None:
            raise UsageError("expected chromium, found none")
        sources = json.loads(files("gsmerge.pages").joinpath("vendor/SOURCES.json").read_text())
        number = sources["packages"]["@sparkjsdev/spark"]["version"]
        endings = (".ply", "opened/a.spz", ".splat", ".sog")
        return Program("Spark", number, endings, partial(spark_values, chromium))

    makers: dict[str, Callable[[], Program]] = {
        "plyfile": lambda: Program("plyfile", version("plyfile"), ("a.ply",), ply_values),
        "splat-transform": splat_transform,
        "gsply": lambda: Program("gsply", version("gsply"), (".ply", ".spz", ".sog"), gsply_values),
        "spark": spark,
        "three.js": lambda: Program(
            "three.js", package("three"), ("a.ply", ".splat", ".spz", ".glb"), partial(three_values, args.npm)
        ),
        "gltf-validator": lambda: Program(
            "gltf-validator", package("gltf-validator"), (".glb",), partial(validate_glb, args.npm)
        ),
        "pycolmap": lambda: Program("pycolmap", version("pycolmap"), (POINTS,), colmap_values),
        "gsplat": lambda: Program("gsplat's trainer", commit(), (POINTS,), partial(trainer_values, args.gsplat)),
    }  # fmt: skip
    for name, make in makers.items():
        try:
            yield make()
        except (PackageNotFoundError, UsageError, OSError, subprocess.CalledProcessError, TypeError) as error:
            print(f"skipped {name}: {error}", file=sys.stderr)


def write_all(source: Path, folder: Path, photos: Path) -> None:
    """Write the Gaussians of a .ply, with harmonics, in every format."""
    gaussians = gsmerge.read_ply(source).gaussians
    harmonics = np.random.default_rng(0).normal(0, 0.1, (len(gaussians), 15, 3)).astype(np.float32)
    gsmerge.write_ply(folder / "a.ply", replace(gaussians, shN=harmonics), overwrite=True)
    for name in NAMES[1:]:
        cameras = viewer_cameras_path(source)
        convert_files(ConvertOptions([folder / "a.ply"], folder / name, cameras, overwrite=True))
    shutil.copytree(photos, folder / FOLDER / "images", dirs_exist_ok=True)


def compare(expected: Values, actual: Values) -> np.ndarray:
    """Return the largest errors of positions, colours and opacities."""
    width = float(np.ptp(expected[:, :3], axis=0).max())
    expected = np.concatenate([expected[:, :3] / width, expected[:, 3:].clip(0, 1)], 1)
    actual = np.concatenate([actual[:, :3] / width, actual[:, 3:].clip(0, 1)], 1)
    columns = np.isfinite(actual).all(0)
    order = np.arange(len(expected))
    if len(actual) != len(expected) or np.abs(actual[:, :3] - expected[:, :3]).max() > 0.01:
        order = cKDTree(expected[:, columns]).query(actual[:, columns])[1]
    errors = np.abs(actual - expected[order]).max(0)
    return np.array([errors[:3].max(), errors[3:6].max(), errors[6]])


def open_with_all(expected: Values, programs: Sequence[Program], file: Path) -> list[str]:
    """Open a file with every program; return the cells of a row: programs, the largest errors, and what others say."""
    names, errors, said = [], [], []
    for program in programs:
        if not str(file).endswith(program.endings):
            continue
        try:
            read = program.open(file)
        except (subprocess.CalledProcessError, ValueError, AssertionError) as error:
            read = f"fails: {error!r}"
        named = f"{program.name} {program.version}"
        if isinstance(read, str):
            said.append(f"{named}: {read}")
        elif len(read) != len(expected):
            said.append(f"{named}: {len(read):,} of {len(expected):,} Gaussians")
        else:
            names.append(named)
            errors.append(compare(expected, read))
    place, color, opacity = np.max(errors, 0)
    cells = [f"{100 * place:.1g} %", f"{color:.1g}", f"{opacity:.1g}" if np.isfinite(opacity) else ""]
    return [", ".join(names), *cells, "; ".join(said)]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path, help="a .ply with its NAME.cameras.json")
    parser.add_argument("out", type=Path)
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--npm", type=Path)
    parser.add_argument("--gsplat", type=Path)
    args = parser.parse_args(arguments)
    out = args.out / "opened"
    os.makedirs(out, exist_ok=True)
    write_all(args.scene, out, args.photos)
    expected, programs = ply_values(out / "a.ply"), list(find_programs(args))
    rows = [[f"`{name}`", *open_with_all(expected, programs, out / name)] for name in NAMES]
    print(f"{len(expected):,} Gaussians")
    print(make_table(("file", "read by", "positions", "colours", "opacities", "besides"), rows))


if __name__ == "__main__":
    main()
