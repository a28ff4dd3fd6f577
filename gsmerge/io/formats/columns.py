"""Recognise columns of a PLY file that do not belong to Gaussians, and ignore them, note them, or refuse the file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmerge.errors import Note, SceneError
from gsmerge.frozen import dataclass
from gsmerge.io.formats import rows as arrays

_MOMENT = "save one moment as a .ply, with positions, rotations and opacities of that time"


@dataclass(frozen=True)
class ColumnKind:
    """Columns with one meaning."""

    what: str  # their content; empty for columns that do not change renders
    names: str  # regular expression of their names
    effect: str = ""  # how renders look without them
    remedy: str = ""  # in the error of files with these columns; empty: a note names the columns


# A column belongs to the first entry of this table whose pattern matches the column's name. Columns of floats that
# match no entry are noted as unknown
COLUMN_KINDS = (
    ColumnKind(
        "when each Gaussian appears",
        r"trbf_.*|(scale|scaling)_?t(_\d+)?|t_scale|(log_)?(life_?(time|span)|duration).*|(opacity|cov|sigma)_t(_\d+)?",
        remedy=_MOMENT,  # Gaussians of all times together show no moment of the scene
    ),
    ColumnKind(
        "Mip-Splatting's filter of all scales",
        "filter_3D",
        remedy="run create_fused_ply.py of Mip-Splatting, which applies it",
    ),
    ColumnKind(
        "anchors, from which a network makes Gaussians",
        r"f_(offset|anchor).*",
        remedy="save the Gaussians of that network as .ply",
    ),
    ColumnKind(
        "the kernels of Beta splats",
        r"beta|sb_(params|number).*|betas?_\d+",
        remedy="train 3D Gaussians on the photos, since no Gaussian has the shape of these kernels",
    ),
    ColumnKind(
        "time and motion",
        r"t|t_?\d+|time(stamp)?|(mu|mean|center)_t|motion.*|omega.*|rot_?[lr](_\d+)?|(angular_)?(velocity|vel|acceleration"
        r"|acc).*|v[xyz]|(delta|d|deform|dynamic|traj|flow|poly|fourier|control|keyframe)_.*|[xyz]_?t?\d+"
        r"|.*_t_?\d+|frames?(_\d+)?",
        "the scene does not move",
    ),
    ColumnKind(
        "materials and light",
        r"(albedo|base_?color|diffuse|specular|spec|roughness|metal|fresnel|refl|emissi|incident|indirect|visibility"
        r"|ambient|brdf|f_brdf|irradiance|radiance|env|asg|sg|transmi|clearcoat|occlusion|ior|f0).*|k[ads](_\d+)?"
        r"|(ind|f_sh|f_asg)_.*",
        "colours are those of f_dc and f_rest",
    ),
    ColumnKind(
        "the shape of other primitives than Gaussians",
        r"(nu|degree|shape|kernel|sharpness|gamma|exponent|epsilon|eps|inverse_deviation|nd|hermite|sites?|skew"
        r"|dof|hardness|edge|cutoff|truncat)(_.*)?|nu_?degree|negative.*",
        "they are drawn as Gaussians",
    ),
    ColumnKind(
        "",
        r"n[xyz]|normals?_.*|red|green|blue|alpha|[rgba]|.*(label|_?ids?|class|categor|segment|instance|object|group|cluster)"
        r"(_.*)?|(.*_)?(mask|selected|state|score|prob|conf|confidence|uncertainty|importance|contribution|weight|quality"
        r"|error|variance|var|count|radii|radius|radii2d|depth|index|idx|generation|age|flag)(_.*)?|conf.*|max_radii2d"
        r"|(obj|sem|semantic|feat|feature|fea|lang|language|clip|dino|sam|ins|embed|latent|f_lang|ancestry|lod|level)"
        r".*",
    ),
)  # fmt: skip
# PLY's names of the integer types with 1, 2 and 4 bytes: signed, unsigned
_WHOLE_TYPES = {"i": ("char", "short", "int"), "u": ("uchar", "ushort", "uint")}


def _find_kind(name: str) -> ColumnKind | None:
    """Return the first of :data:`COLUMN_KINDS` whose pattern matches a column's name; None for an unknown name."""
    return next((kind for kind in COLUMN_KINDS if re.fullmatch(kind.names, name, re.IGNORECASE)), None)


def check_columns(path: Path, row_type: np.dtype[np.void], layers: Sequence[str]) -> tuple[str, ...]:
    """Return a note on columns and elements that are not used, but would change renders; empty if there are none.

    ``layers``: names of other elements that hold Gaussians. Raise SceneError if a column shows that Gaussians are
    incomplete without other data, or if a column of Gaussians has an integer type.
    """
    colors = arrays.color_columns(row_type.names)  # columns such as ``red`` may be bytes
    for name in row_type.names or ():
        dtype = row_type[name]
        is_used = name in (*arrays.REQUIRED_COLUMNS, *colors) or name.startswith("f_rest_")
        is_color_byte = dtype == np.uint8 and name in colors and colors != arrays.SH0
        if is_used and dtype.kind != "f" and not is_color_byte:
            type_name = _WHOLE_TYPES[dtype.kind][dtype.itemsize // 2]
            meaning = "values of 0 to 255" if dtype.itemsize == 1 else "half floats"
            problem = f"expected {name} as float, found {type_name}, which may be {meaning} or indices of a codebook"
            raise SceneError(path, problem, "export it with floats, opacities as logits or in [0, 1]")
    by_kind: dict[ColumnKind | None, list[str]] = {}
    for name in row_type.names or ():
        if name in arrays.REQUIRED_COLUMNS or name.startswith("f_rest_"):
            continue
        kind = _find_kind(name)
        if kind is not None or row_type[name].kind == "f":
            by_kind.setdefault(kind, []).append(name)
    for kind, names in by_kind.items():
        if kind is not None and kind.remedy:
            problem = f"expected complete Gaussians, found columns {list_names(names)} ({kind.what})"
            raise SceneError(path, problem, kind.remedy)
    known = [(kind, names) for kind, names in by_kind.items() if kind and kind.what]
    parts = [f"{list_names(names)} ({kind.what}: {kind.effect})" for kind, names in known]
    parts += [f"{list_names(by_kind[None])} (unknown)"] if None in by_kind else []
    parts += [f"{list_names(layers)} (more Gaussians)"] if layers else []
    unused = [name for kind, names in by_kind.items() if kind is None or kind.what for name in names]
    return (Note(f"not used: {'; '.join(parts)}", "columns", unused),) if parts else ()


def describes_places(name: str) -> bool:
    """Return whether a column may hold positions or directions, such as motion, rather than labels or weights."""
    kind = _find_kind(name)
    return kind is None or bool(kind.what)


def list_names(names: Sequence[str]) -> str:
    """List the names of columns for a message: the first six names, and the number of further names."""
    # most listed names, and most characters of each
    max_names = 6
    max_characters = 60
    num_unlisted = len(names) - max_names
    listed = ", ".join(name[:max_characters] for name in names[:max_names])
    return listed + (f" and {num_unlisted} more" if num_unlisted > 0 else "")
