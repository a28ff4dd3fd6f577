"""Every kind of wrong usage of every command: its exit code, one clear line, nothing written."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest

import gsmerge
from gsmerge.cli import main

from .conftest import Run, assert_refused, listing

# Words after ``gsmerge``, run in a folder with the scene ``room`` of 5 views of 48 x 32, what it is encoded to, and a
# state of it: parts of the error line, with * between them
USAGE = {
    "compact room --k 0": "k: expected 1 to 8, mixed or auto, got 0",
    "compact room --k 9": "k: expected 1 to 8, mixed or auto, got 9",
    "compact room --superpixels 1537": "1536*1537",
    "compact room --superpixels 0": "superpixels",
    "compact room --superpixels 0%": "superpixels",
    "compact room --superpixels 150%": "superpixels",
    "compact room --set segmentation=magic": "segmentation*rdseg",
    "compact room --set match=magic": "--set match*overlap",
    "compact room --magic": "--magic",
    "compact room --set pose=free": "--set pose*the closest name is poses*settings.md",
    "compact room --set poses": "--set: expected NAME=VALUE, got 'poses'",
    "compact room --set overlap=much": "--set overlap: expected a number, got 'much'",
    "compact room --k 2 --set k=2": "--set k: expected it once, got --k too",
    "compact room --hint oder=none": "--hint oder*the closest name is order",
    "compact room --hint max_side=4": "max_side: expected a whole number of at least 16",
    "compact room --threads 0": "--threads",
    "compact room --budget 5B": "budget: expected at least 502 bytes for one Gaussian, got 5",
    "compact room --budget 0.001%": "budget: expected at least one Gaussian, got '0.001%'",
    "compact room --effort slow": "'--effort': 'slow' is not one of 'draft', 'fast', 'default', 'best'",
    "compact room -o a.ksplat": "expected a name that ends in",
    "compact room -o a.spz --budget 5MB": "--budget 5MB: expected an output as .ply, got .spz",
    "compact room -o a.sog --set spz_version=4": "spz_version 4: expected an output as .spz, got .sog",
    "compact room --set photo_scale=0.5": "photo",
    "compact room --set photo_scale=small": "photo",
    "compact room --checkpoint none --set require_checkpoint=true": "require_checkpoint",
    "compact room --method magic": "--method*voxel",
    "compact room --method voxel --budget auto": "method voxel*budget auto",
    "compact room --method voxel --levels 2": "method voxel*levels",
    "compact room --method voxel --quality 20dB": "method voxel*quality 20dB",
    "compact room --method voxel --quality -1dB": "method voxel*quality -1dB",
    "compact room --method blocks --hint order=none": "method blocks*one Gaussian per pixel",
    "compact alone.ply --hint order=none --save-cameras a.json": "a.json: expected a scene with cameras, got none",
    "compact room --budget 0.02": "budget: expected a number of Gaussians*got '0.02'; perhaps \"2%\"",
    "compact room --budget 2.5": "got '2.5'; perhaps \"2.5%\"",
    "compact room --ratio 0.1": "--ratio is no option: use --budget, such as 2%, 40000 or 5MB, or --k;",
    "evaluate room --ratio 0.1": "No such option: --ratio",
    "compact room out.ply": "out.ply: no such scene; name the output with -o",
    "inspect room out.ply": "unexpected extra argument*(out.ply); see",
    "compress room": "No such command 'compress'. Did you mean 'compact'?",
    "metrics room": "Did you mean 'evaluate'?",
    "compct room": "Did you mean 'compact'?",
    "batch room -o out --fit none --quality 30": 'quality: expected a PSNR as "30dB"',
    "batch room -o out --set method=voxel --budget auto": "method voxel",
    "batch room -o out --set require_checkpoint=true --set checkpoint=none": "require_checkpoint",
    "batch room -o out --jobs many": "auto",
    "batch room -o out --max-memory lots": "--max-memory: expected a size such as 8GB",
    "batch room -o out --retries -1": "retries",
    "batch room -o out --name {{stem}}.spz --budget 1MB": "budget 1MB: expected an output as .ply",
    "batch room/scene.ply alone.ply -o out --name same.ply": "a file of its own for each scene",
    "batch room -o out --hint exporter=nobody": "nobody",
    "batch room -o room": "another folder for the results",
    "batch room -o alone.ply": "",
    "encode room --fit full": "--fit",
    "decode room.gsm --k 8": "k: expected 1 to 4",
    "decode room.gsm --k 9": "k: expected 1 to 4, as encoded",
    "decode room.gsm --k 2 --budget 900": "expected one of k and budget",
    "decode room.gsm --budget many": "budget: expected a number",
    "decode room.gsm --budget 10": "expected at least {groups}, one for each group, got 10",
    "decode room.gsm -o room.gsm --overwrite": "other than the input",
    "decode room.gsm -o alone.ply": "alone.ply*--overwrite",
    "decode room.gsm -o a.ply --set spz_version=4": "spz_version 4: expected an output as .spz, got .ply",
    "decode room.gsm --set viewer_cameras=true": "--set viewer_cameras: unknown",
    "decode room.gsm --fit full": "fit full: expected a state with photos, found none",
    "decode state.gsm --k 8": "k: expected 1 to 4",
    "decode state.gsm --k 2 --budget 900": "expected one of k and budget",
    "decode state.gsm --budget 3": "one for each group",
    "decode state.gsm --fit some": "--fit",
    "extend state.gsm": "SCENE",
    "extend state.gsm room --fit full": "--fit",
    "extend state.gsm room --set tolerance=2": "tolerance",
    "extend state.gsm room --max-k 9": "--max-k",
    "extend state.gsm room --set replay=-1": "replay",
    "extend state.gsm room --superpixels 0%": "superpixels",
    "extend state.gsm room --budget many": "budget",
    "extend state.gsm room --hint exporter=nobody": "exporter",
    "extend room/scene.ply room": "other than the input",
    "extend room/transforms.json room": "other than the input",
    "extend state.gsm room room --cameras a --images b": "--cameras and --images: expected one batch with them",
    "render room --as panel -o sheet.jpg": "expected a name that ends in .png",
    "render room alone.ply -o views": "--as views: expected one scene, got 2",
    "render room -o sheet.png --superpixels 100": "expected --as superpixels",
    "render room --as views -o occupied": "--overwrite",
    "render room --as superpixels -o occupied": "--overwrite",
    "render room --path spiral -o a.mp4": "--path spiral: expected orbit, spline or a file of cameras",
    "render room --path orbit:120 -o a.mp4": "path, orbit: expected degrees above 0 and at most 90, got '120'",
    "render room --path spline,back:x -o a": "path, back: expected a share of the depth above 0 and at most 10, got",
    "render room --path spline:30 -o a.mp4": "path: expected spline[,back:SHARE], got spline:30",
    "render room --path orbit -o a.avi": "a.avi: expected a video, .mp4 or .webm, or a folder",
    "render room --path orbit -o a.png": "a.png: expected a video, .mp4 or .webm, or a folder",
    "render room --path orbit --as panel -o a.png": "--path: expected no --as with it, got --as panel",
    "render room --path orbit --superpixels 100 -o a.mp4": "expected --as superpixels",
    "render room --path orbit --frames 1 -o a.mp4": "--frames",
    "render room --path orbit --fps 0 -o a.mp4": "--fps",
    "render room --path orbit --fps 9 -o a": "--fps: expected a video, .mp4 or .webm, got the folder a",
    "render room --path room/targets --frames 9 -o a.mp4": "--frames: expected an orbit or a spline",
    "render room --path orbit -o occupied": "--overwrite",
    "render room --path spline --views 1 -o a.mp4": "expected at least 2 different cameras, got 1",
    "render room -o a.mp4": "a.mp4: expected the path of a video with it, --path orbit, spline",
    "render room --fps 9 -o a": "--frames and --fps: expected the path of a video",
    "view room alone.ply -o a.html --set superpixels=99999": "superpixels: expected at most 1536*got 99999",
    "evaluate room --lpips none --no-context": "--targets",
    "evaluate room --lpips none --target-images room/images": "--targets",
    "evaluate room --lpips none -o room/scene.ply": "ends in .json, .csv, .md, .html",
    "evaluate room --lpips none -o room/transforms.json": "other than the input",
    "evaluate room --lpips none --merge-seconds 1": "that of each of 0 AFTER, got 1",
    "evaluate room alone.ply --lpips none --merge-seconds run.json -o run.json --overwrite": "other than the input",
    "evaluate room --lpips none --align=color": "expected held-out views",
    "evaluate room --lpips none --align=colour --targets room/targets": "color or pose",
    "evaluate room --lpips none --zoom=a,2": "sizes such as .5,1,2,4",
    "evaluate room --lpips none --zoom=0": "zoom: expected 0.0625 to 16, got 0",
    "evaluate room --lpips none --zoom=2,2": "every size once",
    "evaluate room --lpips none --photo-side -1": "greater than or equal to 0",
    "evaluate room --lpips none --views 6": "expected 1 to 5",
    "evaluate room --lpips none --views 3 --targets room/targets": "also name the input views",
    "evaluate room --lpips none -o a.md -o a.md": "got it twice",
    "evaluate room alone.ply alone.ply": "got alone.ply twice",
    "evaluate room --targets room/targets -o room/targets/transforms.json --overwrite": "other than the input",
    "stress room --targets room/targets --report room/targets/transforms.json --overwrite": "other than the input",
    "stress room --cases hail": "expected some of unchanged",
    "chart -o out": "expected scenes to run, or --draw-only",
    "chart -o out room --draw-only": "expected scenes to run, or --draw-only",
    "chart -o out --draw-only --dry-run": "expected something to run",
    "chart -o out --draw-only": "expected finished runs, found none",
    "chart -o out room --k 9": "expected",
    "chart -o out room --views 0": "views: expected numbers from 1",
    "chart -o out room --targets {{room}}/none.json": "expected {{scene}}, {{parent}} or {{stem}}",
    "chart -o out room --lpips some": "--lpips",
    "chart -o room/scene.ply room": "expected a folder, found the file",
    "chart -o room room": "expected another folder for the results",
    "generate -o out --views many": "--views: expected a number such as 6",
    "generate -o out --views 1": "views: expected 2 to 2000",
    "generate -o out --size large": "--size: expected width and height such as 320x240",
    "generate -o out --size 9x9": "width: expected 16 to 2048",
    "generate -o out --style castle": "style: expected mixed, room",
    "generate -o out --path spiral": "path: expected mixed, arc",
    "generate -o out --style building --path orbit": "path: expected walk or mixed in a building, got 'orbit'",
    "train -o out": "--data",
}
PLACES = {
    "compact room --set require_checkpoint=true --checkpoint gone": "gone",
    "batch gone -o out": "gone",
    "batch room -o alone.ply/out --quiet": "cannot be written",
    "extend nowhere/state.gsm room": "nowhere/state.gsm",
    "extend alone.ply/state.gsm room": "alone.ply/state.gsm",
    "extend occupied room": "occupied",
    "extend /proc/self/state.gsm room": "cannot be written (",
    "extend new.gsm gone": "gone",
    "render room --as views -o alone.ply/pictures": "found the file",
    "render room --as superpixels -o alone.ply/pictures": "found the file",
    "render room --path orbit -o nowhere/a.mp4": "nowhere/a.mp4: expected a folder to write to",
    "render room --path room/scene.ply -o a.mp4": "room/scene.ply",
    "evaluate room --lpips none --targets nowhere.json": "expected cameras of held-out views",
    "evaluate room --lpips none --targets room/transforms.json": "the scene was not made of",
    "evaluate room alone.ply --lpips none --merge-seconds room/transforms.json": "total_seconds",
    "evaluate room alone.ply --lpips none --merge-seconds alone.ply": "cannot be read as text",
    "evaluate alone.ply --hint order=none --targets room/targets": "alone.ply: expected cameras to measure from",
    "evaluate alone.ply --hint order=none --views 2": "alone.ply: expected cameras to measure from*with --cameras",
    "stress alone.ply --hint order=none --targets room/targets": "alone.ply: expected cameras to measure from",
    "chart -o out nowhere": "nowhere",
    "chart -o out room --targets {{scene}}/none.json": "expected cameras of held-out views",
    "generate -o out --ranges nowhere.toml": "nowhere.toml: expected a TOML or JSON file",
    "generate -o alone.ply": "found a file",
    "train --data nowhere -o out": "nowhere",
}


NEED_THE_SCENE = {  # to be known as wrong: refused by the plan, all others before any work
    "compact room --superpixels 1537",
    "compact room --budget 5B",
    "compact room --budget 0.001%",
    "compact room --method blocks --hint order=none",
    "compact room --set require_checkpoint=true --checkpoint gone",
}


@pytest.fixture(scope="module")
def prepared(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the calls are run in. Read only."""
    folder = tmp_path_factory.mktemp("prepared") / "work"
    shutil.copytree(small_scene, folder / "room")
    shutil.copy(small_scene / "scene.ply", folder / "alone.ply")
    (folder / "run.json").write_text('{"total_seconds": 2}')
    (folder / "occupied").mkdir()
    (folder / "occupied" / "mine.txt").write_text("precious")
    small = ["--superpixels", "60", "--checkpoint", "none", "--quiet"]
    assert main(["encode", str(small_scene), "-o", str(folder / "room.gsm"), *small]) == 0
    assert main(["extend", str(folder / "state.gsm"), str(small_scene), *small]) == 0
    return folder


@pytest.mark.parametrize("words", [*USAGE, *PLACES])
def test_wrong_usage_is_one_line_and_writes_nothing(
    words: str, prepared: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(*_: object, **__: object) -> None:
        raise AssertionError("wrong usage is refused before the work")

    for name in ("compact_file.compact", "view.data.evaluate") if words not in NEED_THE_SCENE else ():
        monkeypatch.setattr(f"gsmerge.{name}", work)
    monkeypatch.chdir(prepared)
    before = listing(prepared)
    groups = len(gsmerge.load_encoded("room.gsm")) if "{groups}" in USAGE.get(words, "") else 0
    parts = (USAGE | PLACES)[words].format(groups=groups).split("*")
    planned = words.startswith("compact")
    for more in ([], ["--dry-run"]) if planned else ([],):
        assert_refused(run(*shlex.split(words.format()), *more), 2 if words in USAGE else 3, *parts)
    assert listing(prepared) == before
