"""List the exporters that write files of Gaussians, recognise their files, and check hints on how to read a file.

To add a model, add a :class:`Model` to the exporter whose columns, order and encodings it shares, or add an exporter.
``python tasks.py reference`` renews docs/reference/exporters.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gsmerge.frozen import dataclass, fields
from gsmerge.io.cameras.table import FFGS
from gsmerge.reading.alignment import ESTIMATED
from gsmerge.settings.reading import SCENE_ARGUMENTS, Order, ReadHints
from gsmerge.settings.setting import join_words, suggest_name

if TYPE_CHECKING:
    from gsmerge.io.formats.read_gaussians import FileInfo

NO_HINTS = ReadHints()


def make_hints(values: dict[str, Any]) -> ReadHints:
    """Make hints from keyword arguments. Raises ValueError if a name or a value is unknown."""
    names = {field.name for field in fields(ReadHints)}
    unknown = sorted(values.keys() - names)
    if unknown:
        known = sorted({*names, *SCENE_ARGUMENTS})
        suggestion = suggest_name(unknown[0], known)
        raise ValueError(f"unknown argument {unknown[0]!r}{suggestion or f'; expected {join_words(known)}'}")
    return ReadHints(**values)


@dataclass(frozen=True)
class Model:
    """A model or program whose files are known from its source code."""

    title: str  # the name that people use
    source: str  # repository and commit that were read; single files may have a later commit
    output: str  # what files the model writes, beyond what its exporter says
    result: str = "read right"  # how gsmerge reads these files, and what the user has to add
    place: str = ""  # pattern of its files' paths, if no other model with the same columns uses these paths
    camera_advice: str = ""  # a clause that says how to get cameras of its scenes if they are missing


@dataclass(frozen=True)
class Exporter:
    """Code of one or more models that saves Gaussians, and the properties by which its files are recognised."""

    name: str  # on the command line
    models: tuple[Model, ...]  # the models that use it
    opacity: Literal["logit", "raw"]  # how the exporter stores opacities
    order: Order  # order of its rows; "none": rows have no pixels, or are in another order
    degrees: tuple[int, ...] = (0,)  # SH degrees that the exporter writes
    normals: bool = True  # whether the exporter writes the columns nx, ny, nz
    elements: tuple[str, ...] = ()  # elements besides ``vertex`` that the exporter always writes
    byte_columns: tuple[str, ...] = ()  # columns that the exporter writes as bytes
    comment: str = ""  # part of a comment in the header that the exporter always writes
    cameras: tuple[str, ...] = ()  # formats of cameras that it writes; empty: it writes none, and any may be given

    def writes_columns(self, info: FileInfo) -> bool:
        """Return whether a file has the header and the opacities that this exporter writes."""
        return (
            info.sh_degree in self.degrees
            and self.normals == ("nx" in info.columns)
            and info.byte_columns == self.byte_columns
            and set(self.elements) <= set(info.extra_elements)
            and any(self.comment in comment for comment in info.comments or ("",))
            and info.opacity_encoding == self.opacity
        )

    @property
    def is_marked(self) -> bool:
        """Return whether the exporter's files have an element, column or comment that no other exporter writes."""
        return bool(self.elements or self.byte_columns or self.comment)


_NORMALS = ("nx", "ny", "nz")
# Values of ``Model.result``
_NAME_CAMERAS = "read right with cameras, or with those that its grid shows"
_NO_PIXELS = "read without pixels"
_IF_GRID_SHOWS = "read right where the rows show their grid, else without pixels"
_WITH_CAMERAS = "read without pixels; photos are used where cameras are named"
# ``Model.place`` and ``Model.camera_advice`` of programs that train scenes
_TRAINED = "iteration_*/point_cloud.ply", "cameras.json of the run has the cameras: name its folder, or the file itself"

_EXPORTERS = (
    Exporter(
        "da3",
        (
            Model(
                "Depth Anything 3", source="ByteDance-Seed/Depth-Anything-3 2c21ea8; `utils/export/gs.py` 831637d",
                output="`gs_ply/0000.ply` without borders and the farthest tenth of each view; cameras of the nested"
                " model in another unit, in `exports/*/results.npz` or COLMAP's files where they are asked for",
                result='read right with `export_format="npz-gs_ply"`, `"mini_npz-gs_ply"` or `"colmap-gs_ply"`, and'
                " alone",
                place="0000.ply", camera_advice='export_format="npz-gs_ply" writes its cameras beside the file',
            ),
            Model(
                "Lyra 2", source="nv-tlabs/lyra 67392d9",
                output="`reconstructed_scene.ply` of half the size, without borders; `cameras.npz`",
                result=f"{_NO_PIXELS}, with its frames",
                place="reconstructed_scene.ply",
                camera_advice="its cameras.npz has the cameras: keep it beside the file",
            ),
        ),
        "logit", "view-major",
        cameras=("DA3 npz", "COLMAP binary", "COLMAP text", ESTIMATED),
    ),
    # Models of the pixelSplat family share code, but differ in the order of rows, trimmed borders and rotations. Each
    # model centres the world on its median, divides it by a quantile and rotates it upright. No file stores scale and
    # shift.
    Exporter(
        "pixelsplat",
        (Model("pixelSplat", "dcharatan/pixelsplat 32b1b66", "`gaussians/RUN/STEP.ply`; no cameras", _NAME_CAMERAS),),
        "raw", "view-major",
    ),
    Exporter(
        "pixelsplat-script",
        (
            Model(
                "pixelSplat's figure script", "dcharatan/pixelsplat 32b1b66",
                "`point_clouds/SCENE/gaussians.ply`, far pixels dropped; no cameras", _WITH_CAMERAS,
            ),
        ),
        "raw", "view-fastest",
    ),
    Exporter(
        "mvsplat",
        (
            Model(
                "MVSplat", "donydchen/mvsplat 175b17a",
                "`point_clouds/SCENE/gaussians.ply` of two views, far pixels dropped; no cameras", _WITH_CAMERAS,
            ),
        ),
        "raw", "view-fastest",
    ),
    Exporter(
        "spfsplat",
        (
            Model(
                "SPFSplat", "ranrhuang/SPFSplat 15e158d, its second version SPFSplatV2 74349e7",
                "`NAME_gaussians.ply` beside `NAME_input_0.png` and drawings; no cameras", _NAME_CAMERAS,
            ),
        ),
        "raw", "view-fastest",
    ),
    Exporter(
        "depthsplat",
        (
            Model(
                "DepthSplat", "cvg/depthsplat 2dad25a; the exporter in a copy, marcoleg/depthsplat 12f7ec4",
                "`gaussians/NAME.ply`, 8 pixels trimmed; `images/NAME/color/`; no cameras", _NAME_CAMERAS,
            ),
        ),
        "logit", "view-fastest",
    ),
    Exporter(
        "zpressor",
        (
            Model(
                "ZPressor", "ziplab/ZPressor 84b3080", "`gaussians/NAME.ply`, 4 pixels trimmed; no cameras",
                _NAME_CAMERAS,
            ),
        ),
        "raw", "view-fastest",
    ),
    Exporter(
        "volsplat",
        (
            Model(
                "VolSplat", "ziplab/VolSplat 01ef574; the exporter in a copy, dzp62442/VolSplat cacc0bc",
                "voxels padded or cut to the number of pixels, then trimmed as DepthSplat's, with rotations that are"
                " wrong; no cameras", f"{_WITH_CAMERAS}; padding is left out",
            ),
        ),
        "logit", "none",
    ),
    Exporter(
        "resplat",
        (
            Model(
                "ReSplat", "copies: mohammed1916/resplat, baoxperceptionio/resplat",
                "`gaussians.ply` on a grid of a quarter of the photos' size; `input/`; no cameras", _WITH_CAMERAS,
            ),
        ),
        "logit", "view-major", degrees=(3,),
    ),
    Exporter(
        "noposplat",
        (
            Model("NoPoSplat", "cvg/NoPoSplat 9b04307", "what its user's call of `export_ply` names", _NAME_CAMERAS),
            Model("TriSplat", "ziplab/TriSplat fcd7ab1; not what calls the exporter", "no cameras", _NAME_CAMERAS),
        ),
        "raw", "view-major", degrees=(0, 4),
    ),
    Exporter(
        "yonosplat",
        (
            Model(
                "YoNoSplat", "a copy, lksrz/YoNoSplat",
                "`debug_info/SCENE_gaussians.ply`, 8 pixels trimmed, opacities above 0.01; no cameras",
                "read right with cameras; without where no row is missing",
            ),
        ),
        "raw", "view-fastest",
    ),
    Exporter(
        "vicasplat",
        (
            Model(
                "VicaSplat", "WU-CVGL/VicaSplat d1e9368; `demo.py` 4282959, `ply_export.py` 0db1ad3",
                "opacities from 0.005 on, sorted; harmonics in axes of their own; `transforms.json` as a list of poses"
                " without intrinsics, `context/`", f"{_NO_PIXELS}; add the focal length to its poses",
            ),
            Model("NAS3R", "mxlcanfly/NAS3R 2ad17fa", "as VicaSplat, with raw opacities; no cameras", _WITH_CAMERAS),
        ),
        "logit", "none", degrees=(0, 4),
    ),
    Exporter(
        "flash3d",
        (Model("Flash3D", "eldar/flash3d", "two layers of one photo; no cameras", _NAME_CAMERAS),),
        "raw", "none",
    ),
    Exporter(
        "splatt3r",
        (
            Model(
                "Splatt3R", "btsmart/splatt3r bda1dd0", "`gaussians.ply` of two views; no cameras",
                "read right with its photos",
            ),
        ),
        "raw", "view-major",
    ),
    # Models that merge Gaussians in voxels or across views.
    Exporter(
        "anysplat",
        (
            Model(
                "AnySplat", "InternRobotics/AnySplat 57937e4; a copy, LiYukeee/AnySplat 2f01e79",
                "`gaussians.ply` among the photos or beside `images/`, in the copy with logits; no cameras",
                _WITH_CAMERAS,
            ),
            Model("FreeSplat", "wangys16/FreeSplat", "fused views in pixelSplat's upright frame", _WITH_CAMERAS),
            Model("C3G", "a copy, erenovic/C3G 6ba7c4b", "Gaussians of tokens; no cameras", _WITH_CAMERAS),
        ),
        "raw", "none",
    ),
    Exporter(
        "worldmirror",
        (
            Model(
                "WorldMirror 1", "Tencent-Hunyuan/HunyuanWorld-Mirror c61300e",
                "voxels of 0.002; COLMAP's files; `images/`, squeezed where it cropped, and `images_resized/`",
                _NO_PIXELS,
            ),
            Model(
                "WorldMirror 2", "Tencent-Hunyuan/HY-World-2.0 05d3035; `inference_utils.py` 270f4b4",
                "as WorldMirror 1, without masked pixels, at most 5,000,000 drawn at random; `camera_params.json`,"
                " COLMAP's files on request; no photos", f"{_NO_PIXELS}; name the photos",
            ),
        ),
        "raw", "none",
    ),
    # Models that predict Gaussians from one image, or from a few images of one object.
    Exporter(
        "sharp",
        (
            Model(
                "SHARP", "apple/ml-sharp 1eaa046; `utils/gaussians.py` 22ac1c0",
                "`NAME.ply` of 14 columns, sRGB, the camera inside", "read right with its photo",
            ),
        ),
        "logit", "none", normals=False, elements=("extrinsic", "intrinsic"),
    ),
    Exporter(
        "splatter-image",
        (
            Model(
                "Splatter Image", "a copy of the demo's `utils/vis_utils.py`",
                "opacities above 0.08, scales made larger, turned for a viewer; no cameras", _IF_GRID_SHOWS,
            ),
        ),
        "logit", "view-major", degrees=(1,),
    ),
    Exporter(
        "lgm",
        (
            Model(
                "LGM", "3DTopia/LGM be6a87f", "an object of four views that are not kept, and a film", _IF_GRID_SHOWS
            ),
            Model("GRM", "justimyhxu/GRM 0d4efb1", "an object, turned for a viewer", "read right with cameras"),
            Model(
                "GS-LRM", "Intern-Nexus/gs-lrm-unofficial 2c2b68d, with LGM's saving code", "no cameras",
                "read right with cameras",
            ),
            Model(
                "FlashWorld", "imlixinyang/FlashWorld c8df52d", "every pixel, in the first camera's frame",
                "read right with cameras",
            ),
        ),
        "logit", "view-major", normals=False,
    ),
    # Long-LRM writes normals as bytes, and always 45 values of higher harmonics, whatever their degree. When Long-LRM
    # prunes, it sorts rows by opacity.
    Exporter(
        "longlrm",
        (
            Model(
                "Long-LRM", "arthurhero/Long-LRM d92dd51; `data/dataset.py` 1fccf47, `main.py` 3c35270",
                "`gaussians_001.ply`; `input_frame_idx.txt`, whose frames show the mean pose that it is in",
                "read right with the data set's file of cameras",
                camera_advice="the data set's .json file has the cameras: name it with --cameras",
            ),
            Model(
                "tttLRM", "cwchenwang/tttLRM 1d133c2",
                "`gaussians_001.ply` in the mean pose of its cameras, without faint rows; no cameras",
                "read right with cameras of its views alone",
            ),
        ),
        "logit", "view-major", degrees=(3,), byte_columns=_NORMALS,
    ),
    Exporter(
        "longlrm-sorted",
        (Model("Long-LRM, sorted", "arthurhero/Long-LRM d92dd51", "as Long-LRM, where it prunes", _NO_PIXELS),),
        "logit", "none", degrees=(3,), byte_columns=_NORMALS,
    ),
    # Scenes that were optimised, or predicted without pixels.
    Exporter(
        "inria",
        (
            Model(
                "INRIA 3DGS", "ten copies of graphdeco-inria/gaussian-splatting",
                "`point_cloud/iteration_N/point_cloud.ply`, `cameras.json`",
                f"{_NO_PIXELS}; name the photos", *_TRAINED,
            ),
            Model(
                "InstantSplat", "NVlabs/InstantSplat 3c29c20; `train.py` 3bb6a7f",
                "as INRIA 3DGS; `pose/ours_N/pose_optimized.npy`", f"{_NO_PIXELS}; name the photos", *_TRAINED,
            ),
            Model("ZipSplat", "cvg/ZipSplat 69fd35b", "`scene.ply` of tokens and a film; no cameras", _WITH_CAMERAS),
            Model(
                "SAM 3D Objects", "facebookresearch/sam-3d-objects; `gaussian_model.py` aa18aba",
                "an object in a box of its own", _NO_PIXELS,
            ),
        ),
        "logit", "none", degrees=(0, 1, 2, 3), cameras=("INRIA cameras.json",),
    ),
    Exporter(
        "nerfstudio",
        (
            Model(
                "nerfstudio", "nerfstudio-project/nerfstudio 50e0e3c",
                "`splat.ply` in its own frame; `dataparser_transforms.json` with the map into that", _WITH_CAMERAS,
                camera_advice="the transforms.json that it was trained on has the cameras: name it with --cameras, and"
                " keep dataparser_transforms.json beside the file",
            ),
        ),
        "logit", "none", degrees=(0, 1, 2, 3), comment="Nerstudio",
    ),
    Exporter(
        "ffgs",
        (
            Model(
                "ffgs", "PyPI, ffgs 0.1.0.dev1; `examples/infer_pose_free.py`",
                "`gaussians.ply` of voxels or tokens; `cameras.json` at the size of the model's input", _NO_PIXELS,
            ),
        ),
        "logit", "none", degrees=(0, 1, 2, 3, 4), cameras=(FFGS,),
    ),
    Exporter(
        "gsplat",
        (
            Model(
                "gsplat", source="nerfstudio-project/gsplat 90d7b4b", output="`ply/point_cloud_STEP.ply`; no cameras",
                result=_WITH_CAMERAS,
                place="ply/point_cloud_*.ply",
                camera_advice="the COLMAP model that it was trained on has the cameras: name it with"
                " --cameras",
            ),
        ),
        "logit", "none", degrees=(0, 1, 2, 3), normals=False,
    ),
)  # fmt: skip
EXPORTERS = {exporter.name: exporter for exporter in _EXPORTERS}


def find_exporter(name: str) -> Exporter | None:
    """Return the exporter with a name; None for "auto". ValueError for an unknown name."""
    if name != "auto" and name not in EXPORTERS:
        raise ValueError(f"exporter: expected 'auto' or one of {', '.join(EXPORTERS)}, got {name!r}")
    return EXPORTERS.get(name)


def choose_exporters(name: str, info: FileInfo, order: str, cameras: str) -> tuple[Exporter, ...]:
    """Return the exporter with a name; for "auto", all exporters that may have written the file.

    An exporter may have written the file if it writes the file's columns, the format of its ``cameras`` ("" without
    cameras), and its ``order`` of rows ("none" if rows have no pixels). If exporters that leave a mark in their files
    match, only they are returned, even if none of them writes rows in the order ``order``.
    """
    exporter = find_exporter(name)
    if exporter is not None:
        return (exporter,)
    possible = [entry for entry in EXPORTERS.values() if entry.writes_columns(info)]
    possible = [entry for entry in possible if not entry.cameras or cameras in entry.cameras]
    marked = [entry for entry in possible if entry.is_marked]
    return tuple([entry for entry in marked or possible if entry.order == order] or marked)


def find_cameras_of_model(info: FileInfo) -> str:
    """Describe how to get the cameras of a file from the model that wrote it; empty if the model is unknown.

    A model is recognised by the path of the file, or by a mark of its exporter. The text is also empty if recognised
    models give different advice.
    """
    path = Path(info.path).absolute()
    models = [
        model
        for exporter in EXPORTERS.values()
        if exporter.writes_columns(info)
        for model in exporter.models
        if model.camera_advice and (path.match(model.place) if model.place else exporter.is_marked)
    ]
    advice = {model.camera_advice for model in models}
    return f"{' or '.join(model.title for model in models)}: {advice.pop()}" if len(advice) == 1 else ""
