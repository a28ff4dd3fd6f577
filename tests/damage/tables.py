"""Crops from files: what is none."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from .case import Damage, refuse
from .changes import write

BOX, SPHERE = {"shape": "box"}, {"shape": "sphere"}
ORIGIN, ONES = [0, 0, 0], [1, 1, 1]


def matrix(rows: np.ndarray) -> dict[str, Any]:
    return {"matrix": rows.tolist()}


def write_crop(*said: object, place: str = "", **table: Any) -> Damage:
    """Another table in the place of a crop."""
    return refuse(write(json.dumps(table)), *said, place=f"a.json: {place}" if place else "")


def of_crop() -> dict[str, Damage]:
    shear = np.eye(4) + np.eye(4, k=1) * [0, 0.1, 0, 0]
    ball = SPHERE | {"center": ORIGIN, "radius": 1}
    return {
        "an unknown shape": write_crop("box", "sphere", "'ball'", place="shape", shape="ball"),
        "a shape in a list": write_crop("box", "sphere", place="shape", shape=["box"]),
        "no shape": write_crop(None, place="shape", center=ORIGIN, radius=1),
        "a shape alone": write_crop("neither", **BOX),
        "a box of two forms": write_crop("min, size", **BOX, min=ORIGIN, size=ONES),
        "a turned ball": write_crop("center, radius, rotate", **ball, rotate=[0, 0, 1]),
        "a corner of two numbers": write_crop(3, place="min", **BOX, min=[0, 0], max=ONES),
        "a corner with a word": write_crop(3, place="min", **BOX, min=[0, 0, "a"], max=ONES),
        "a corner with a list": write_crop(3, place="min", **BOX, min=[[0], 0, 0], max=ONES),
        "a box without inside": write_crop("x0 < x1", **BOX, min=[1, 0, 0], max=ONES),
        "a radius of 0": write_crop("above 0", **ball | {"radius": 0}),
        "a radius of true": write_crop(1, place="radius", **ball | {"radius": True}),
        "a huge radius": write_crop("1e+15", **ball | {"radius": 1e300}),
        "a matrix of 3 x 3": write_crop("4 x 4", place="matrix", **BOX, **matrix(np.eye(3))),
        "a flat matrix": write_crop(place="matrix", **BOX, **matrix(np.diag([1, 1, 0, 1]))),
        "a matrix of ones": write_crop(place="matrix", **BOX, **matrix(np.ones((4, 4)))),
        "a sheared matrix": write_crop("cosine", **BOX, **matrix(shear)),
        "a ball of two scales": write_crop("one scale", **SPHERE, **matrix(np.diag([1, 2, 1, 1]))),
    }


DAMAGES = {"crop": of_crop()}
