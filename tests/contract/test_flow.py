"""The flow reads from top to bottom: options end in the plan, notes go to the record, there is one kind of scene."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import gsmerge
from gsmerge.facts.prepare import Prepared, PrepareOptions

PACKAGE = Path(gsmerge.__file__).parent
STEPS = ("facts", "stages", "fit")


@functools.cache
def texts(*rooms: str) -> dict[Path, str]:
    """Return the sources of the package, or of some of its folders."""
    paths = [path for room in rooms or ("",) for path in sorted((PACKAGE / room).rglob("*.py"))]
    return {path: path.read_text(encoding="utf-8") for path in paths}


def functions(text: str) -> Iterator[ast.FunctionDef]:
    yield from (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef))


def test_the_pipeline_nests_no_functions() -> None:
    nested = [
        inner.name
        for outer in functions(texts()[PACKAGE / "pipeline.py"])
        for inner in ast.walk(outer)
        if isinstance(inner, ast.FunctionDef) and inner is not outer
    ]
    assert nested == []


def test_no_stage_knows_the_options_of_another() -> None:
    assert len(texts(*STEPS)) > 30
    assert [path.name for path, text in texts(*STEPS).items() if "CompactOptions" in text] == []


def test_no_step_reads_the_options_that_the_plan_decides() -> None:
    open_choice = re.compile(r"(?<![.\w])options\s*\.\s*(effort|recipe|checkpoint)\b")
    assert [path.name for path, text in texts(*STEPS).items() if open_choice.search(text)] == []


def test_no_function_takes_the_record_of_a_run() -> None:
    for path, text in texts().items():
        if path.name == "record.py" or not re.search(r":\s*Record\b", text):
            continue
        for function in functions(text):
            arguments = [*function.args.args, *function.args.kwonlyargs]
            kinds = {ast.unparse(one.annotation) for one in arguments if one.annotation is not None}
            assert not {"Record", "Record | None"} & kinds, f"{path}: {function.name}"


def test_no_code_beyond_io_asks_for_the_kind_of_a_scene() -> None:
    call = re.compile(r"\bisinstance\([^()]*(\([^()]*\)[^()]*)*,[^()]*\(?[^()]*\bScene\b")
    for path, text in texts().items():
        assert {PACKAGE / "io", PACKAGE / "scene"} & {*path.parents} or not call.search(text), path


def test_prepared_facts_are_few() -> None:
    assert len(fields(Prepared)) <= 8


def test_prepared_facts_hold_no_options() -> None:
    assert not {f.name for f in fields(Prepared)} & {f.name for f in fields(PrepareOptions)}
    assert all("Options" not in str(f.type) for f in fields(Prepared))
