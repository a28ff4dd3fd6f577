"""``gsmerge batch``: many scenes, each on its own."""

import json
import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import RunEnd, print_document, say, separate_stdout, terminal_columns, total_progress
from gsmerge.errors import USUAL, BatchError, Doubt, TargetError, UsageError, count_words, split_notes
from gsmerge.settings.budget import AUTO
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.setting import Setting
from gsmerge.settings.stages import Engine

if TYPE_CHECKING:
    from gsmerge.jobs.batch import BatchOptions, Job

JOBS = Setting("Number of scenes to run at the same time, or auto.", kind=int | Literal["auto"], least=1)
MAX_LISTED = 20  # rows of the table, failures, and doubtful results
TABLE_HEADER = ("result", "Gaussians", "of", "kept", "new views", "own before", "own after", "seconds")
OMITTED_FIRST = ("of", "seconds", "own before", "own after", "kept")  # columns that a narrow terminal omits, in order
# Kind of a reason -> word that begins its line, and noun for counting the lines that are not listed
REASONS = {
    "change": ("changed", "change"), "doubt": ("warning", "warning"), "unmet": ("missed target", "missed target"),
    "lacking": ("note", "note"), "error": ("failed", "failure"),
}  # fmt: skip


SETTINGS = (CompactOptions, Engine)


def batch(
    scenes: Annotated[list[str], opt.argument("FOLDER|PATTERN|LIST...", "Folders to search for scenes, patterns such "
        "as *.ply, .ply files, or text files with one of these per line.", read=None)],
    *,
    cameras: Annotated[str | None, opt.option(opt.INPUT, "TEXT", "Cameras: one path for all scenes, or a pattern in "
        "which {scene}, {parent} and {stem} are replaced by those of each scene; none: without.",
        default="beside each")] = None,
    images: Annotated[str | None, opt.option(opt.INPUT, "TEXT", "Folder of the photos: a path or such a pattern; none: "
        "without.", default="beside each")] = None,
    masks: Annotated[str | None, opt.option(opt.INPUT, "TEXT", "Folder of the masks of the photos, as in compact: a "
        "path or such a pattern, as '{parent}/masks'; none: without.", default="beside the photos of each")] = None,
    protect: Annotated[str | None, opt.option(opt.INPUT, "TEXT", "Folder of images, white where a text or a face has "
        "to stay sharp: a path or such a pattern.")] = None,
    hint: opt.Hint = None, budget: opt.Budget = None, quality: opt.Quality = None, levels: opt.Levels = None,
    k: opt.K = None, effort: opt.Effort = None, fit: opt.Fit = None,
    set: Annotated[list[str] | None, opt.settings_option(SETTINGS)] = None,
    jobs: Annotated[opt.Parsed | None, opt.option(opt.RUNNING, "N|auto", JOBS.help, read=opt.reader(JOBS.read),
        default=AUTO)] = None,
    engine: opt.OnRay = None, crop: opt.Crop = None, drop: opt.Drop = None,
    output: Annotated[Path, opt.output("Folder for the results. Scenes whose results are already in it are skipped.")],
    name: Annotated[str, opt.option(opt.OUTPUT, "NAME", "Name of each result; {stem}, {parent}, {index} and {k} are "
        "replaced.", default="{stem}.ply")] = "{stem}.ply",
    overwrite: Annotated[bool, opt.option(opt.OUTPUT, "", "Compact all scenes again. Also replace files in the folder "
        "that were not written by a batch with these settings.", "--overwrite")] = False,
    strict: opt.Strict = False, dry_run: opt.DryRun = False, seed: opt.Seed = None,
    threads: Annotated[str | None, opt.option(opt.GENERAL, "NUMBER", "Number of threads of each scene.",
        default="processors divided by jobs")] = None,
    json: Annotated[bool, opt.option(opt.OUTPUT, "", "Print one line of JSON per scene on stdout.", "--json")] = False,
    progress: opt.Progress = None, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Compact many scenes, each on its own. A failure stops no other scene, and a second call continues."""
    if output.exists() and not output.is_dir():
        raise UsageError(f"--output: expected a folder, found the file {output}")
    reading = opt.read_hints(hint)
    given = opt.read_settings(
        SETTINGS, set, budget=budget, quality=quality, levels=levels, k=k, effort=effort, fit=fit, crop=crop, drop=drop,
        engine=engine, seed=seed, threads=threads,
    )  # fmt: skip
    from gsmerge.jobs.batch import BatchOptions, find_jobs
    from gsmerge.jobs.batch.find import describe_lost
    from gsmerge.jobs.batch.records import RecordIndex

    settings, ray = given.make(*SETTINGS)
    try:
        options = BatchOptions(
            settings, *reading, cameras=cameras, images=images, masks=masks, protect=protect, output=name,
            jobs=None if jobs == AUTO else jobs, overwrite=overwrite, engine=ray.engine, address=ray.address,
        )  # fmt: skip
    except ValueError as error:
        raise UsageError(str(error).replace("output:", "--name:", 1)) from error
    if options.engine == "ray" and not dry_run:
        from gsmerge.runtime.work import require_ray

        require_ray()
    looks: list[str] = []
    planned = find_jobs(scenes, output, options, {*RecordIndex(output).read_on().paths()}, looks)
    notes = describe_lost(looks, {job.scene for job in planned})
    if dry_run:
        _print_plan(output, planned, options, notes, as_json=json)
    else:
        _run(output, planned, options, notes, strict=strict, as_json=json, quiet=quiet)


def _run(
    out: Path, jobs: "Sequence[Job]", options: "BatchOptions", notes: Sequence[str], *,
    strict: bool, as_json: bool, quiet: bool,
) -> None:  # fmt: skip
    """Compact all scenes, print a summary, and raise an error if some failed or missed their target."""
    from gsmerge.jobs.batch import run_batch
    from gsmerge.jobs.batch.records import FAILED, SKIPPED
    from gsmerge.jobs.batch.run import choose_concurrency

    totals = Totals(len(jobs))
    silent = quiet or as_json
    say(f"{count_words(len(jobs), 'scene')}, {choose_concurrency(jobs, options)}", quiet=silent)
    stdout = sys.stdout
    try:
        with (
            separate_stdout(options.engine, quiet=silent),
            closing(run_batch(jobs, out, options)) as records,
            total_progress(len(jobs), quiet=silent) as progress,
        ):
            for num_ended, record in enumerate(records, 1):
                totals.add(record)
                if as_json:
                    print(json.dumps(record, separators=(",", ":")), file=stdout, flush=True)
                failure = record["error"] or ""
                num_skipped = totals.counts[SKIPPED]
                num_failed = totals.counts[FAILED]
                # skipped scenes take no time, so the time left is estimated without them
                share = 1.0 if num_ended == len(jobs) else (num_ended - num_skipped) / (len(jobs) - num_skipped)
                report = record["report"]  # None for a failure, and for a result that was done before
                record_notes = [Doubt(text) for text in record["doubts"]] if report is None else report["notes"]
                progress(
                    RunEnd(
                        record["scene"],
                        status=record["status"],
                        done=num_ended,
                        failure=failure,
                        num_failed=num_failed,
                        share=share,
                        notes=record_notes,
                    )
                )
    finally:
        if not silent:
            print_document(
                {}, [*totals.lines(terminal_columns(sys.stdout)), *map("note: {}".format, notes)], as_json=False
            )
    doubtful = totals.reasons["doubt"]
    num_doubtful = totals.count_scenes("doubt")
    results = count_words(totals.total - len(totals.reasons["error"]), "result")
    problem = (
        f"{num_doubtful} of {results} {'is' if num_doubtful == 1 else 'are'} doubtful"
        f"{_first_reason(doubtful, listed=not silent)}"
    )
    if doubtful and not strict:
        say(problem, kind="warning", quiet=silent)
    check_failures(totals.reasons["error"], len(jobs), "scene", listed=not silent)
    if unmet := totals.reasons["unmet"]:
        raise TargetError(f"{len(unmet)} of {results} missed the target{_first_reason(unmet, listed=not silent)}")
    if doubtful and strict:
        raise TargetError(problem)


def check_failures(failed: Sequence[tuple[str, str]], total: int, unit: str, *, listed: bool = False) -> None:
    """Raise BatchError if jobs ``failed`` (name, reason). ``unit`` is the word for one of the ``total`` jobs.

    The message has the first reason, unless all reasons have been ``listed`` already.
    """
    if failed:
        raise BatchError(f"{len(failed)} of {count_words(total, unit)} failed{_first_reason(failed, listed=listed)}")


def _first_reason(reasons: Sequence[tuple[str, str]], *, listed: bool) -> str:
    """Return the end of a message: the first scene and its reason.

    The end is empty if there is no reason, or if all reasons have been ``listed`` already.
    """
    return "" if listed or not reasons else "; the first: {}: {}".format(*reasons[0])


@dataclass
class Totals:
    """Results of a batch, for the lines that are printed at its end."""

    total: int  # scenes
    counts: Counter[str] = field(default_factory=Counter)  # scenes by status; "in" and "out": Gaussians
    rows: list[tuple[str, ...]] = field(default_factory=list)  # rows of the table, for the first results
    # Kind of reason -> scenes with their reasons. Doubts and missed targets of skipped results also count
    reasons: dict[str, list[tuple[str, str]]] = field(default_factory=lambda: {name: [] for name in REASONS})

    def add(self, record: Mapping[str, Any]) -> None:
        """Add the record of one scene to the totals."""
        from gsmerge.io.formats.rows import describe_gain
        from gsmerge.method.facts.pictures import ROW_COLORS
        from gsmerge.method.raster.metrics import MAX_PSNR, psnr_figure
        from gsmerge.runtime.memory import human_share

        report = record["report"]
        reasons = [("unmet", record["unmet"]), ("error", record["error"])]
        reasons += [("doubt", doubt) for doubt in record["doubts"]]
        changes = report["choices"].get("changes", ()) if report else ()
        reasons += [("change", change) for change in split_notes(changes, USUAL)[1]]
        if report and not report["input"]["num_photos"] and {*record["doubts"]} <= {report["worse"]}:
            if report["input"]["num_views"]:
                own = report.get("psnr_reference") == ROW_COLORS
                measured = f"; its numbers are of {ROW_COLORS}" if own else ""
                lack = f"no photos found beside it or in the named folder{measured}; name them with --images"
            else:
                place = "no cameras found beside it or in the named folder"
                lack = f"{place}; name them with --cameras, and photos with --images"
            reasons.append(("lacking", lack))
        for kind, reason in reasons:
            if reason:
                self.reasons[kind].append((record["scene"], reason))
        self.counts[record["status"]] += 1
        if not report:
            return
        self.counts["in"] += report["input"]["num_gaussians"]
        self.counts["out"] += report["output"]["num_gaussians"]
        if len(self.rows) >= MAX_LISTED:
            return
        psnr = report["psnr_input_views"]
        quality = [
            "" if psnr[name] is None else psnr_figure(psnr[name], report["choices"]).removesuffix(" dB")
            for name in ("before", "after")
        ]
        if fidelity := report["choices"].get("fidelity"):
            # without photos the result is compared with the input
            quality = ["the input", "equal" if fidelity["psnr"] >= MAX_PSNR else f"{fidelity['psnr']:.2f}"]
        counts = [f"{report[name]['num_gaussians']:,}" for name in ("output", "input")]
        new = report["new_views"]
        gain = "" if new is None else describe_gain(new["low"], new["high"])
        share = human_share(report["ratio"])
        seconds = f"{report['total_seconds']:.1f}"
        self.rows.append((record["output"], *counts, share, gain, *quality, seconds))

    def count_scenes(self, kind: str) -> int:
        """Count the scenes that have reasons of a kind."""
        return len({scene for scene, _ in self.reasons[kind]})

    def lines(self, columns: int | None = None) -> list[str]:
        """Return the last lines of a batch: a table of results, reasons of each kind, and a line of totals.

        The table is at most ``columns`` wide.
        """
        from gsmerge.io.image_names import natural_key
        from gsmerge.jobs.batch.records import DONE, FAILED, SKIPPED
        from gsmerge.runtime.documents import text_table
        from gsmerge.runtime.memory import human_share
        from gsmerge.runtime.record import list_some

        rows = [TABLE_HEADER, *sorted(self.rows, key=lambda row: natural_key(row[0]))]
        lines = (
            text_table(rows, letters=columns, omitted_first=list(map(TABLE_HEADER.index, OMITTED_FIRST)))
            if self.rows
            else []
        )
        lines += [f"... and {self.counts[DONE] - len(self.rows):,} more"] * (self.counts[DONE] > len(self.rows))
        for name, (word, noun) in REASONS.items():
            alike: dict[str, dict[str, str]] = {}  # kind -> scene -> reason
            for scene, reason in self.reasons[name]:
                # changes of one kind differ in their numbers
                kind = re.sub(r"\d[\d.,]*\d|\d", "...", reason) if name == "change" else reason
                alike.setdefault(kind, {})[scene] = reason
            grouped = []
            for kind, reason_of in alike.items():
                first, *others = dict.fromkeys(reason_of.values())
                # A reason that begins with the scene's name is a line by itself
                is_named = first.startswith(next(iter(reason_of)))
                scenes = list_some(sorted(reason_of, key=natural_key))
                grouped.append(first if is_named else f"{scenes}: {kind if others else first}")
            lines += [f"{word}: {line}" for line in grouped[:MAX_LISTED]]
            lines += [f"... and {count_words(len(grouped) - MAX_LISTED, f'more {noun}')}"] * (len(grouped) > MAX_LISTED)
        counts = {status: self.counts[status] for status in (DONE, SKIPPED, FAILED)}
        counts["left"] = self.total - sum(counts.values())
        parts = [f"{count:,} {status}" for status, count in counts.items() if count > 0 or status == DONE]
        total_line = f"{count_words(self.total, 'scene')}: {', '.join(parts)}"
        if num_input := self.counts["in"]:
            share = human_share(self.counts["out"] / num_input)
            total_line += f"; {num_input:,} -> {self.counts['out']:,} Gaussians ({share})"
        for name, words in (("unmet", "missed the target"), ("doubt", "doubtful")):
            count = self.count_scenes(name)
            total_line += f"; {count:,} {words}" if count else ""
        return [*lines, total_line]


def _print_plan(
    out: Path, jobs: "Sequence[Job]", options: "BatchOptions", notes: Sequence[str], *, as_json: bool
) -> None:
    """Print which scenes a batch would compact, for ``--dry-run``; BatchError if some would fail."""
    from gsmerge.jobs.batch.run import choose_concurrency, pending_jobs
    from gsmerge.runtime.documents import document_head, note_entries

    pending = pending_jobs(jobs, out, options)
    concurrency = choose_concurrency(jobs, options)
    pending_scenes = {job.scene: refusal for job, refusal in pending}  # None: the scene would be compacted
    num_refused = sum(refusal is not None for refusal in pending_scenes.values())
    num_pending = len(pending) - num_refused
    document = {
        **document_head(),
        "dry_run": True,
        "output": str(out),
        "num_scenes": len(jobs),
        "num_pending": num_pending,
        "jobs": concurrency.jobs,
        "threads": concurrency.threads,
        "scenes": [
            {
                "scene": job.scene,
                "output": job.output,
                "num_gaussians": job.num_gaussians,
                "done": job.scene not in pending_scenes,
                "error": pending_scenes.get(job.scene),
            }
            for job in jobs
        ],
        "options": options.settings.to_dict(),
        **note_entries(notes),
    }
    lines = [f"{job.scene} -> {f'refused: {refusal}' if refusal else out / job.output}" for job, refusal in pending]
    lines += [
        f"would write {out}: {num_pending:,} of {count_words(len(jobs), 'scene')} to do, {concurrency}",
        *map("note: {}".format, notes),
    ]
    print_document(document, lines, as_json=as_json)
    if num_refused:
        raise BatchError(
            f"{num_refused:,} of {count_words(len(jobs), 'scene')} would fail;"
            " faults inside their files show only in the run"
        )
