"""The flow reads from top to bottom: options end in the plan, notes go to the record, one scene."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import gsmerge
from gsmerge.facts.prepare import Prepared, PrepareOptions

PACKAGE = Path(gsmerge.__file__).parent


def functions(path: Path) -> Iterator[ast.FunctionDef]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    yield from (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def names_in(node: ast.AST) -> set[str]:
    return {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}


def test_the_pipeline_nests_no_functions() -> None:
    nested = [
        inner.name
        for outer in functions(PACKAGE / "pipeline.py")
        for inner in ast.walk(outer)
        if isinstance(inner, ast.FunctionDef) and inner is not outer
    ]
    assert nested == []


def test_no_stage_knows_the_options_of_another() -> None:
    paths = sorted(path for room in ("facts", "stages", "fit") for path in (PACKAGE / room).rglob("*.py"))
    assert len(paths) > 30
    assert [path.name for path in paths if "CompactOptions" in path.read_text(encoding="utf-8")] == []


def test_only_the_plan_reads_what_is_left_to_it() -> None:
    """Effort, recipe and checkpoint names."""
    open_choices = {"effort", "recipe", "checkpoint"}
    for path in sorted(path for room in ("facts", "stages", "fit") for path in (PACKAGE / room).rglob("*.py")):
        read = {
            node.attr
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "options"
        }
        assert not read & open_choices, path


def test_the_record_is_in_no_signature() -> None:
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.name == "record.py":
            continue
        for function in functions(path):
            arguments = [*function.args.args, *function.args.kwonlyargs]
            kinds = {ast.unparse(one.annotation) for one in arguments if one.annotation is not None}
            assert not {"Record", "Record | None"} & kinds, f"{path}: {function.name}"


def test_scenes_are_of_one_kind() -> None:
    for path in sorted(PACKAGE.rglob("*.py")):
        if {PACKAGE / "io", PACKAGE / "scene"} & {*path.parents}:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance":
                assert "Scene" not in names_in(node.args[1]), path


def test_facts_are_few_and_hold_no_options() -> None:
    assert len(fields(Prepared)) <= 7
    assert not {f.name for f in fields(Prepared)} & {f.name for f in fields(PrepareOptions)} - {"unseen"}
    assert all("Options" not in str(f.type) for f in fields(Prepared))
