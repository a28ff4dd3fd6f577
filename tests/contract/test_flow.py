"""The flow reads from top to bottom: options end in the plan, notes go to the record, there is one kind of scene."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import gsmerge
from gsmerge.method.facts.prepared import Prepared
from gsmerge.settings.stages import PrepareOptions

PACKAGE = Path(gsmerge.__file__).parent
STEPS = ("prepare", "method/stages", "method/fit")


@functools.cache
def texts(*rooms: str) -> dict[Path, str]:
    """Return the sources of the package, or of some of its folders."""
    paths = [path for room in rooms or ("",) for path in sorted((PACKAGE / room).rglob("*.py"))]
    return {path: path.read_text(encoding="utf-8") for path in paths}


def functions(text: str) -> Iterator[ast.FunctionDef]:
    yield from (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef))


def test_pipelines_nest_no_functions() -> None:
    nested = [
        inner.name
        for text in texts("method/pipelines").values()
        for outer in functions(text)
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
        assert {PACKAGE / "io", PACKAGE / "reading"} & {*path.parents} or not call.search(text), path


def test_prepared_facts_are_few() -> None:
    assert len(fields(Prepared)) <= 9


def test_prepared_facts_hold_no_options() -> None:
    assert not {f.name for f in fields(Prepared)} & {f.name for f in fields(PrepareOptions)}
    assert all("Options" not in str(f.type) for f in fields(Prepared))


READS_TEXT = {
    "startswith",
    "endswith",
    "find",
    "index",
    "count",
    "split",
    "partition",
    "removeprefix",
    "match",
    "search",
}


NOTES = r"\b(notes|doubts|adapted)"  # names of what holds notes; a file without them need not be parsed


def note_names(loop: ast.For | ast.comprehension) -> set[str]:
    """Return the variables of a loop over notes or doubts; empty for another loop."""
    is_of_notes = re.search(rf"{NOTES}\W*$", ast.unparse(loop.iter)) is not None
    return {node.id for node in ast.walk(loop.target) if isinstance(node, ast.Name)} if is_of_notes else set()


def reads_of_notes(tree: ast.AST) -> Iterator[str]:
    """List where code compares a note, or searches in its text."""
    for loop in (node for node in ast.walk(tree) if isinstance(node, ast.For | ast.ListComp | ast.GeneratorExp)):
        loops = [loop] if isinstance(loop, ast.For) else loop.generators
        names = set().union(*map(note_names, loops))
        for node in ast.walk(loop):
            is_name = isinstance(node, ast.Compare) and any(
                isinstance(side, ast.Name) and side.id in names for side in (node.left, *node.comparators)
            )
            is_call = (
                isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in READS_TEXT
            )
            if is_name or (is_call and any(isinstance(n, ast.Name) and n.id in names for n in ast.walk(node))):
                yield ast.unparse(node)
    for node in ast.walk(tree):
        is_search = isinstance(node, ast.Compare) and any(isinstance(op, ast.In | ast.NotIn) for op in node.ops)
        if is_search and re.search(r"\bnotes$", ast.unparse(node.comparators[-1])):
            yield ast.unparse(node)


def test_no_code_reads_the_words_of_notes() -> None:
    """What a note is about is data of it (:class:`gsmerge.errors.Note`); the record alone drops what it has twice."""
    read = {path.relative_to(PACKAGE).as_posix(): text for path, text in texts().items() if re.search(NOTES, text)}
    found = {path: [*reads_of_notes(ast.parse(text))] for path, text in read.items()}
    assert {path: reads for path, reads in found.items() if reads and path != "runtime/record.py"} == {}


def test_reading_the_words_of_a_note_is_found() -> None:
    for code in (
        "[note for note in load.notes if note.startswith('x')]",
        "any(text == WORSE for text in report.doubts)",
        "if 'no photos' in record.notes: pass",
        "for note in self.notes:\n    if re.search('x', note): pass",
    ):
        assert len([*reads_of_notes(ast.parse(code))]) == 1, code
