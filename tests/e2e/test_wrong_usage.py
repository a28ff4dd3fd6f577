"""Wrong usage of every command ends in its exit code and one clear line, with nothing written."""

from __future__ import annotations

import json
import os
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from bare_files import write_without_grid
from PIL import Image
from shared import write_small

import gsmerge
from gsmerge.cli import app, main
from gsmerge.errors import SceneError
from gsmerge.jobs.batch.find import find_scenes

from .conftest import Run, assert_refused, listing

# Words after ``gsmerge``, run in a folder with the scene ``room`` of 5 views of 48 x 32, two states and Feature
# Gaussians of it: the place that the error line names, none for some, and values in it, with * between them
USAGE = {
    "compact room --k 9": "--k*1 to 8*9",
    "compact room --set superpixels=1537": "superpixels*1536*1537",
    "compact room --set superpixels=0%": "--set superpixels*'0%'",
    "compact room --set match=magic": "--set match*overlap*'magic'",
    "compact room --magic": "*--magic",
    "compact room --force": "*--force*--overwrite",
    "room --force": "*--force*--overwrite*gsmerge compact",
    "compact room --format spz": "*--format*--output",
    "compact room --qualty 3": "*--qualty*--quality",
    "compact room --zzz": "*No such option*--zzz*'gsmerge compact --help'",
    "compact room --fit-steps 60": "*--fit-steps*--set fit_steps=VALUE",
    "batch room -o out --require-checkpoint": "*--require-checkpoint*--set require_checkpoint=true",
    "compact room.gsm --no-normals": "*--no-normals*--set normals=false",
    "inspect room --order none": "*--order*--hint order=VALUE",
    "lab generate -o out --noise 0": "*--noise*--set noise=VALUE",
    "extend a.gsm room --seed 3": "*--seed*--set seed=VALUE",
    "compact room -overwrite": "-overwrite*two dashes*--overwrite",
    "render room -output=a.png": "-output=a.png*two dashes*--output=a.png",
    "--quiet room": "*--quiet",
    "compact ''": "SCENE*empty",
    "convert a.ply ''": "IN... OUT*empty",
    "batch '' -o out": "FOLDER|PATTERN|LIST*empty",
    "''": "*No such command",
    "compact --threads two room": "--threads*whole number*'two'",
    "inspect room --progress jsno": "--progress*bar or json*'jsno'",
    "nowhere.txt": "*No such command*nowhere.txt",
    "--install-completion": "*--install-completion",
    "compact room -effort draft": "-effort*--effort",
    "compact room --up y": "*--up",
    "lab chart room --k 1,2": "*--k*--set k=VALUE",
    "inspect room alone.ply --cameras room": "--cameras, --images and --masks*one scene",
    "chart room": "*'chart'",
    "compact room --set pose=free": "--set pose*unknown*poses*--set help",
    "compact room --set overlap=much": "--set overlap*'much'",
    "compact room --k 2 --set k=2": "--set k*--k too",
    "compact room --set look": "--set*NAME=VALUE*'look'*auto, scene or photos",
    "compact room --hint oder=none": "--hint oder*unknown*order",
    "compact room --threads 0": "--threads*1",
    "compact room --budget 5B": "budget*579*5",
    "compact room --effort slow": "--effort*'slow'*draft",
    "render room -o a.png --masks photos": "*--masks",
    "convert alone.ply": "*only alone.ply*gsmerge convert alone.ply x.spz",
    "compact room --effort BEST": "--effort*'BEST'*perhaps best",
    "compact room --budget quest": "--budget*'quest'*perhaps quest3",
    "compact room --set match=aab": "--set match*'aab'*perhaps aabb",
    "compact room -o -": "--output*got -",
    f"compact room -o {os.devnull}": f"{os.devnull}*ends in .ply",
    "compact room -o a.ksplat": "a.ksplat*.ply*lod-meta.json",
    "convert room a.usda": "a.usda*ends in*.spz*.glb",
    "compact room --set checkpoint=none --set require_checkpoint=true": '--set require_checkpoint*"none"',
    "compact room --set method=magic": "--set method*random*'magic'",
    "compact room --set method=greedy --budget auto": "method greedy*budget auto",
    "compact room --budget 2 --dry-run": 'budget*5*got 2*"2%"',
    "compact room --budget -1dB": "--budget*'-1dB'*--quality -1dB",
    "compact room --threads 99999999999999999999999": "--threads*1024",
    "convert alone.ply a.ply --scale 1e-300": "--scale, --translate*1e-30*1e30",
    "convert alone.ply a.ply --translate 4e38,0,0": "--scale, --translate*1e30*4e+38",
    "convert alone.ply a.ply --drop sky": "--drop sky*--images",
    "compact room --budget 0.02": "--budget*'0.02'*\"2%\"",
    "compact room --ratio 0.1": "*--ratio*--budget",
    "room room": "room*twice*-o",
    "compacc room": "*'compacc'*perhaps compact",
    "compress room": "*'compress'*perhaps compact",
    "info room": "*'info'*perhaps inspect",
    "roum": "*'roum'*name a file or folder that exists*perhaps room",
    "convert alone.ply spz": "spz*format*-o alone.spz",
    "compact room -o SOG": "SOG*format*-o scene.sog",
    "compact room --quality 90": "--quality*'90'*usually 20 to 40 dB",
    "batch room -o out --set fit=none --quality 30": "--quality*'30'",
    "batch room -o out --jobs many": "--jobs*auto*'many'",
    "batch room -o room": "room*results",
    "batch room -o alone.ply": "--output*alone.ply",
    "compact room.gsm -o room.gsm --overwrite": "room.gsm*not written",
    "compact room.gsm -o alone.ply": "alone.ply*--overwrite",
    "compact paper.gsm --k 8": "k*1 to 4*8",
    "compact paper.gsm --budget 10": "--budget*paper.gsm",
    "compact paper.gsm --strict": "--strict*paper.gsm",
    "compact paper.gsm --cameras room/transforms.json": "--cameras*paper.gsm",
    "compact paper.gsm room": "paper.gsm*only input*2",
    "extend state.gsm room --set max_views=0": "--set max_views*1*0",
    "extend state.gsm room --set levels=2": "--set levels*compact",
    "compact state.gsm --fit some": "--fit*'some'",
    "extend state.gsm room --fit full": "*--fit*fit=VALUE",
    "extend room/scene.ply room": "room/scene.ply*.gsm",
    "extend occupied room": "occupied*.gsm",
    "extend state.gsm room room --cameras a --images b": "--cameras, --images and --masks*several",
    "render room -o sheet.png --set superpixels=100": "*--set",
    "render room -o occupied": "occupied*empty*--overwrite",
    "render room -o sheet.xyz": "sheet.xyz*.png*folder",
    "render room -o a.gif --size 1920": "--size*1920x1080",
    "render room -o a.gif --size 1920x8": "--size*16 to 16384",
    "render room --path spiral -o a.mp4": "--path spiral*orbit*spline",
    "render room --path orbit:120 -o a.mp4": "path, orbit*'120'",
    "render room --path orbit -o a.png": "a.png*.gif*--path",
    "render room --path orbit --frames 1 -o a.mp4": "--frames*2",
    "render room --path room/targets --frames 9 -o a.mp4": "--frames*--views",
    "render room --path spline --views 1 -o a.mp4": "spline*2*1",
    "render room --frames 9 -o a": "--frames*--path",
    "evaluate room --lpips none --no-context": "*--no-context*--set context=false",
    "evaluate room --lpips none -q": "--quiet*-o*--json",
    "evaluate room --lpips none --set context=false": "context=false*held-out*--targets",
    "evaluate room --lpips none --target-images room/images": "--target-images*--targets",
    "evaluate room --lpips none -o room/scene.ply": "room/scene.ply*.json or .csv",
    "evaluate room --lpips none -o room/transforms.json": "room/transforms.json*input",
    "evaluate room alone.ply --lpips none -o run.json": "run.json*exists already",
    "evaluate room --lpips none --set photo_side=-1": "--set photo_side*0",
    "evaluate room --lpips none --set views=6": "views*1 to 5*6",
    "evaluate room --lpips none -o a.csv -o ./a.csv": "a.csv*twice",
    "evaluate room alone.ply alone.ply": "*alone.ply*twice",
    "evaluate room --targets room/targets -o room/targets/transforms.json": "targets/transforms.json*input",
    "lab stress room --cases hail": "cases*unchanged*'hail'",
    "lab chart -o out": "out*finished*none",
    "lab chart -o out room --grid k=9": "k*1 to 8*9",
    "lab chart -o out room --grid kk=1": "--grid kk=1*NAME=A,B",
    "lab chart -o out --dry-run": "--dry-run*scenes",
    "lab chart -o out room --targets {{room}}/none.json": "*{{scene}}*{{room}}/none.json",
    "lab chart -o out room --set lpips=some": "--set lpips*'some'",
    "lab chart -o room/scene.ply room": "--output*room/scene.ply",
    "lab chart -o room room": "room*results",
    "lab generate -o out --views many": "--views*whole number*'many'",
    "lab generate -o out --size large": "--size*1920x1080*'large'",
    "lab generate -o out --set noise=loud": "--set noise*10*'loud'",
    "lab train -o out": "*'--data'",
}
PLACES = {
    "nowhere.ply": "nowhere.ply*no such file",
    "compact https://example.org/a.ply": "https://example.org/a.ply*URL*download",
    "compact room --cameras room/transform.json": "room/transform.json*no such*perhaps transforms.json",
    "./nowhere": "nowhere*no such file",
    "some/nowhere": "some/nowhere*no such file",
    "compact nowhere.ply -o q": "nowhere.ply",
    "compact room --images heic -o a.ply": "heic*found 2 .heic*convert all*mogrify -format jpg heic/*.HEIC",
    "compact room --images heic/film.mov -o a.ply": "heic/film.mov*found a film*save the frames",
    "compact room alone.ply -o a.ply": "alone.ply*to join*no cameras*by itself",
    "compact room --images room/transforms.json": "room/transforms.json*folder of photos*file",
    "compact room/transforms.json": "room/transforms.json*cameras*--cameras",
    "inspect other/view_000.png": "other/view_000.png*picture*model",
    "compact room --images occupied": "occupied*none*--images",
    "compact room --images other -o a.ply": "other*5 views*48 x 32*none*--images",
    "evaluate room --lpips none --targets occupied/absolute.json": "absolute.json*photos*targets*--target-images",
    "compact room --set require_checkpoint=true --set checkpoint=gone": "gone*checkpoint",
    "batch gone -o out": "gone*no such",
    "batch room/transforms.json -o out": "transforms.json*list*JSON",
    "batch room -o alone.ply/out --quiet": "alone.ply/out*Not a directory*--output",
    "extend alone.ply/state.gsm room": "alone.ply/state.gsm*Not a directory",
    "extend new.gsm gone": "gone*no such",
    "render room -o alone.ply/pictures": "alone.ply/pictures*work/alone.ply",
    "render room --path room/scene.ply -o a.mp4": "room/scene.ply*cameras inside",
    "evaluate room --lpips none --targets nowhere.json": "nowhere.json*cameras*no such file",
    "evaluate room --lpips none --targets room/transforms.json": "room/transforms.json*held-out views*was made from",
    "evaluate alone.ply --hint order=none --targets room/targets": "alone.ply*none*--cameras",
    "lab stress alone.ply --set targets=room/targets": "alone.ply*none*--cameras",
    "lab chart -o out nowhere": "nowhere*no such",
    "lab chart -o out room --targets {{scene}}/none.json": "room/none.json*cameras*nothing",
    "lab generate -o alone.ply": "alone.ply*folder*file",
    "lab train --data nowhere -o out": "nowhere*no such",
}


NEED_THE_SCENE = {  # to be known as wrong: refused by the plan, all others before any work
    "compact room --set superpixels=1537",
    "compact room --budget 5B",
    "compact room --set require_checkpoint=true --set checkpoint=gone",
    "compact room alone.ply -o a.ply",
    "compact room --images other -o a.ply",
}


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that the calls are run in. Read only."""
    folder = tmp_path_factory.mktemp("prepared") / "work"
    room = write_small(folder / "room")
    write_without_grid(room / "scene.ply", folder / "alone.ply")
    (folder / "other").mkdir()
    for name in "012":
        Image.new("RGB", (20, 30)).save(folder / f"other/view_00{name}.png")
    targets = json.loads((folder / "room/targets/transforms.json").read_text())
    for frame in targets["frames"]:
        frame["file_path"] = str(folder / "room/targets" / frame["file_path"])
    (folder / "run.json").write_text("{}")
    (folder / "occupied").mkdir()
    (folder / "occupied" / "mine.txt").write_text("precious")
    (folder / "heic").mkdir()
    for name in ("a.HEIC", "b.heic", "film.mov"):
        (folder / "heic" / name).write_bytes(b"\0")
    (folder / "occupied/absolute.json").write_text(json.dumps(targets))
    small = ["--set", "superpixels=60", "--set", "checkpoint=none", "--quiet"]
    paper = ["--set", "superpixels=60", "--set", "recipe=paper", "--quiet"]
    for name, words in (("room", small), ("state", small), ("paper", paper)):
        assert main(["extend", str(folder / f"{name}.gsm"), str(room), *words]) == 0
    return folder


@pytest.mark.parametrize("words", [*USAGE, *PLACES])
def test_wrong_usage_is_refused_in_one_line_before_the_work(
    words: str, prepared: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(*_: object, **__: object) -> None:
        raise AssertionError("wrong usage is refused before the work")

    if words.startswith("lab train --data"):
        pytest.importorskip("torch", reason="torch is not installed")
    for name in ("run.compact_scene", "drawing.pages.data.evaluate") if words not in NEED_THE_SCENE else ():
        monkeypatch.setattr(f"gsmerge.{name}", work)
    monkeypatch.chdir(prepared)
    before = listing(prepared)
    parts = (USAGE | PLACES)[words].format().split("*")
    planned = words.startswith("compact") and ".gsm" not in words
    for more in ([], ["--dry-run"]) if planned else ([],):
        assert_refused(run(*shlex.split(words.format()), *more), 2 if words in USAGE else 3, *parts)
    assert listing(prepared) == before


def test_tilde_is_the_home_folder_wherever_a_path_begins(
    smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(smallest_copy.parent))
    monkeypatch.setenv("USERPROFILE", str(smallest_copy.parent))  # which Windows calls it
    quick = ("--dry-run", "--json", "--effort", "draft")
    for words in (("-o", "~/x.ply"), ("--output=~/x.ply",), ("-o~/x.ply",)):
        document = json.loads(run("compact", f"~/{smallest_copy.name}", *words, *quick, code=0).out)
        assert document["output"]["path"] == str(smallest_copy.parent / "x.ply")


def test_a_name_that_begins_with_a_tilde_is_taken_as_it_stands(
    smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of copies that editors make; also for outputs, in lists, and in Python. No home folder is one line."""
    monkeypatch.chdir(smallest_copy.parent)
    scene = smallest_copy.rename("~scan").absolute()
    quick = ("--dry-run", "--json", "--effort", "draft")
    for words, output in (((), "~scan/scene.compact.ply"), (("-o", "~scan/x.ply"),) * 2, (("-o", "~x.ply"),) * 2):
        path = json.loads(run("compact", "~scan", *words, *quick, code=0).out)["output"]["path"]
        assert path == (output if isinstance(output, str) else output[1])
    gaussians = gsmerge.read_gaussians(Path("~scan/scene.ply")).gaussians
    gsmerge.write_gaussians("~scan/y.ply", gaussians)
    assert (scene / "y.ply").is_file()
    (scene / "list.txt").write_text("~copy.ply\n")
    shutil.copy(scene / "scene.ply", scene / "~copy.ply")
    assert list(find_scenes(["~scan/list.txt"], Path("out"))) == [Path("~scan/~copy.ply")]
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as where the user has no home folder
    assert_refused(run("compact", "~/scan", "-o", "x.ply"), 3, "~/scan", "HOME")
    assert_refused(run("compact", "~scan", "-o", "~/x.ply"), 3, "~/x.ply", "HOME")
    assert_refused(run("compact", "~nobody"), 3, "~nobody", "no such file")
    with pytest.raises(SceneError, match="~/scan"):
        gsmerge.read_scene("~/scan")


def test_help_as_a_word_prints_what_the_option_prints(run: Run) -> None:
    assert run("help", code=0).out == run("--help", code=0).out == run(code=0).out
    assert run("help", "convert", code=0).out == run("convert", "--help", code=0).out


def commands(command: Any, *words: str) -> Iterator[tuple[list[str], Any]]:
    """Return each command with the words that call it, its arguments among them."""
    needed = [f"{param.name}.ply" for param in command.params if param.param_type_name == "argument" and param.required]
    yield [*words, *needed], command
    for word, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, *words, word)


def test_half_typed_option_is_refused_by_every_command(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No value, an empty or another option's, a switch with a value, another last letter."""
    made = app.make_command()
    monkeypatch.setattr(app, "make_command", lambda only=None: made)
    monkeypatch.chdir(tmp_path)
    for words, command in commands(made):
        options = [param for param in command.params if param.param_type_name == "option"]
        for option, name in ((one, name) for one in options for name in one.opts):
            others = [word for other in options if other.required and other is not option for word in other.opts[:1]]
            tails = [[name], [name, "--help"], [name, ""]] if not option.is_flag else []
            if name.startswith("--"):
                tails += [[f"{name}x"], [f"{name}=x"] if option.is_flag else [f"{name}="]]
            for tail in tails:
                outcome = run(*words, *(part for word in others for part in (word, "d")), *tail)
                assert_refused(outcome, 2, "")
                assert option.opts[0] in outcome.err or tail[0] in outcome.err, outcome.err
    assert not any(tmp_path.iterdir())


def test_failure_while_an_error_is_explained_is_one_line(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(app, "usage_message", lambda *_: {}["lost"])
    assert_refused(run("compact", "--k"), 1, "", "unexpected error: KeyError: 'lost'; run again with --debug")
