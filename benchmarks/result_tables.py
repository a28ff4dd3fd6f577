"""Tables of run records as one page, each under the words that say what it is of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from defaults import make_section
from result_cells import (
    QUALITY,
    Row,
    describe_run,
    format_interval,
    format_mean,
    format_quality,
    format_share,
    group_runs,
    make_table,
)

from gsmerge.measure.speed import break_even
from gsmerge.research.charts.lines import Results, make_verdict_tables
from gsmerge.research.charts.measure_run import INPUT, SUPERPIXELS, RunRecord
from gsmerge.runtime.memory import human_bytes

OURS = "gsmerge"
COMMAND = "python benchmarks/results.py"
SHARE = "4.4%"  # budget of what has to be of one count with networks and without


def page_of(records: Mapping[str, Sequence[RunRecord]], defaults: Sequence[Mapping[str, Any]]) -> str:
    """The whole document; parts that were not run are left out. ``defaults`` are those of ``defaults.py``."""
    good = {name: [r for r in some if r.error is None and r.method != SUPERPIXELS] for name, some in records.items()}
    failed = [r for some in records.values() for r in some if r.error is not None]
    sections = [_head(good), *_methods(good), *_verdicts(good), *_backbones(good), *_views(good), *_timing(good)]
    sections += [*_ablation(good), *_voxels(good), *_proxy(good), *_scenes(good), make_section(defaults)]
    sections.append(_losing(good))
    if failed:
        lines = sorted({f"- {r.scene}, {r.label}: {r.error}" for r in failed})
        sections.append("## Runs that failed\n\n" + "\n".join(lines))
    return "\n\n".join(section for section in sections if section) + "\n"


def _head(parts: Mapping[str, Sequence[RunRecord]]) -> str:
    one = next((r for some in parts.values() for r in some), None)
    machine = "" if one is None else ", ".join(f"{k} {v}" for k, v in one.environment.items())
    scenes = sorted({r.scene for some in parts.values() for r in some})
    return f"""# Results

Everything here is measured by `{COMMAND}`, which is resumable; `--only PART` measures a part. Scenes:
{", ".join(scenes)}: real photos and cameras with a real network's depth, written as feed-forward backbones write them.
Figures are means over the scenes, of held-out views midway between the input views and over the pixels that the input
views have seen (the paper's supplement A), unless a section says otherwise. LPIPS is that of VGG, on two views of each
scene. Seconds are the wall time of the merge alone, without reading, writing and scoring. Intervals are 95 % t
intervals over the scenes. Settings have their names in Python: `match none` is `--set match=none`.

Machine: {machine}."""


def _section(title: str, parts: str, words: str, table: str, *figures: str) -> str:
    """A section with the command that makes it, its table and its charts."""
    pictures = [f"![{name}](results/{name}.png)" for name in figures]
    return "\n\n".join(filter(None, [f"## {title}", f"Made by `{COMMAND} --only {parts}`. {words}", table, *pictures]))


def _methods(parts: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """gsmerge and the baselines at several sizes."""
    records = parts.get("sizes", ())
    groups = group_runs(records, lambda r: (r.method != INPUT, r.settings.get("budget", ""), r.method, describe_run(r)))
    if not groups:
        return []
    size = {"": 1e9}
    order = sorted(
        groups, key=lambda k: (k[0], size.get(str(k[1]), float(str(k[1]).rstrip("%") or 0)), str(k[2]) != OURS)
    )
    rows = [
        (describe_run(some[0]), format_share(some), format_interval(some, "psnr_target_visible"),
         *format_quality(some)[1:],
         "" if some[0].method == INPUT else format_mean(some, "seconds", 1), format_mean(some, "render_ms", 0))
        for some in (groups[k] for k in order)
    ]  # fmt: skip
    head = ("method", "kept", "PSNR (dB)", *QUALITY[1:], "seconds", "ms a frame")
    figures = ("quality-seconds", "quality-ratio", "stages", "break-even")
    words = "`unmerged-fit` is the input after the same fit with fast effort."
    return [_section("gsmerge and the baselines", "sizes", words, make_table(head, rows), *figures)]


def _verdicts(parts: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """Whether a baseline's point lies above gsmerge at equal cost."""
    tables = make_verdict_tables(Results(parts.get("sizes", ())))
    head = ("baseline", "its value", "gsmerge", "difference", "verdict")
    out = []
    for table in tables:
        rows = []
        for label, verdict in table.rows:
            d = table.decimals
            ours = "-" if verdict.ours is None else f"{verdict.ours:.{d}f}"
            ahead = "-" if verdict.ahead is None else f"{verdict.ahead.mean:+.{d}f}"
            rows.append((f"{verdict.baseline}, {label}", f"{verdict.quality:.{d}f}", ours, ahead, verdict.words))
        above = [row[0] for row in rows if row[3] != "-" and float(row[3]) < 0]
        cheaper = sum(row[2] == "-" for row in rows)
        summary = f"Of {len(rows) - cheaper} points none lies above gsmerge on the mean."
        if above:
            summary = f"Above gsmerge on the mean: {'; '.join(above)}."
        if cheaper:
            summary += f" {cheaper} points are cheaper than any of gsmerge, so not compared."
        out.append(f"### {table.title}\n\n{summary}\n\n" + make_table(head, rows))
    return ["## Is any baseline better than gsmerge at equal cost?", *out] if out else []


def _backbones(parts: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """The counterpart of the paper's table of backbones and methods: masked, unmasked, and on the input views."""
    rows, bare, own = [], [], []
    for style, name in (("views", "plain"), ("da3", "da3"), ("depthsplat", "depthsplat"), ("anysplat", "anysplat")):
        records = parts.get(style, ())
        if style == "views":
            records = [r for r in parts.get("ablation", ()) if set(r.settings) <= {"k"}]
            records = [
                *records,
                *(
                    r
                    for r in parts.get("sizes", ())
                    if r.method == "moment-matching" and r.settings.get("budget") == "4.4%"
                ),
            ]
        for some in group_runs(records, lambda r: (r.method != INPUT, r.method, r.settings.get("k", 1))).values():
            label = (name, describe_run(some[0]), format_share(some))
            rows.append((*label, *format_quality(some)))
            bare.append((*label, *format_quality(some, part="")))
            own.append((*label, *format_quality(some, "context", "")))
    if not rows:
        return []
    head = ("export", "method", "kept", *QUALITY)
    words = (
        "One depth network, written as four programs write their files: what differs is order, encoding, frames and"
        " what is left out or voxelised, not the network. The paper's table compares four networks. All input views."
    )
    title = "Backbones (the paper's table of novel view synthesis)"
    return [
        _section(title, "ablation da3 depthsplat anysplat", words, make_table(head, rows)),
        "### Without the visibility mask\n\n" + make_table(head, bare),
        "### On the input views\n\n" + make_table(head, own),
    ]


def _views(parts: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """The counterpart of the paper's table by number of views."""
    records = [r for r in parts.get("views", ()) if r.views_asked is not None]
    if not records:
        return []
    scenes: dict[int, set[str]] = {}
    for record in records:
        scenes.setdefault(record.views_asked or 0, set()).add(record.scene)
    common = set.intersection(*scenes.values())
    head = ("views", "scenes", "method", "kept", *QUALITY)
    words = (
        f"Evenly spread contexts, targets midway between them. Table and figures are of the scenes that have so many"
        f" views: {', '.join(sorted(common))}."
    )
    same = make_table(head, _by_count([r for r in records if r.scene in common]))
    title = "By number of input views"
    return [
        _section(title, "views", words, same, "quality-views", "count-views"),
        "### Each number over all scenes that have as many\n\n" + make_table(head, _by_count(records)),
    ]


def _by_count(records: Sequence[RunRecord]) -> list[Row]:
    """A row for each number of views and method."""
    rows = []
    for count in sorted({r.views_asked for r in records if r.views_asked is not None}):
        at = [r for r in records if r.views_asked == count]
        for some in group_runs(at, lambda r: (r.method != INPUT, r.method, r.settings.get("k", 1))).values():
            rows.append((str(count), str(len(some)), describe_run(some[0]), format_share(some), *format_quality(some)))
    return rows


def _timing(parts: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """The counterpart of the paper's table of storage, render time and break-even."""
    records = [r for r in parts.get("views", ()) if r.views_asked is not None]
    rows = []
    for count in sorted({r.views_asked for r in records if r.views_asked is not None}):
        at = [r for r in records if r.views_asked == count]
        before = {r.scene: r for r in at if r.method == INPUT}
        after = {r.scene: r for r in at if r.method == OURS and not r.settings}
        pairs = [(before[s], after[s]) for s in before if s in after]
        if not pairs:
            continue
        counts, sizes, times, (_, merge) = (_pair_means(pairs, n) for n in ("count", "bytes", "render_ms", "seconds"))
        even = break_even(merge, times[0] / 1000, times[1] / 1000)
        rows.append(
            (str(count), str(len(pairs)), f"{counts[0] / 1e6:.2f} M", f"{counts[1] / 1e6:.3f} M", human_bytes(sizes[0]),
             human_bytes(sizes[1]), f"{sizes[0] / sizes[1]:.1f} x", f"{times[0]:.0f}", f"{times[1]:.1f}",
             f"{times[0] / times[1]:.1f} x", f"{merge:.1f}", "-" if even is None else f"{even:.0f}")
        )  # fmt: skip
    if not rows:
        return []
    head = (
        "views",
        "scenes",
        "input",
        "gsmerge",
        "input",
        "gsmerge",
        "smaller",
        "ms",
        "ms",
        "faster",
        "merge s",
        "break-even",
    )
    words = "K = 1, on the processor."
    return [_section("Storage, render time and break-even", "views", words, make_table(head, rows))]


def _pair_means(pairs: Sequence[tuple[RunRecord, RunRecord]], name: str) -> tuple[float, float]:
    first, second = (float(np.mean([pair[i].value(name) or 0 for pair in pairs])) for i in (0, 1))
    return first, second


ABLATION = {
    (): "full (K = 1)",
    (("match", "none"),): "without merging across views",
    (("budget", SHARE), ("checkpoint", "none"), ("fit", "none")): "without any fit: the analytic stages alone",
    (("budget", SHARE), ("checkpoint", "shipped"), ("fit", "none")): "without any fit: with the networks that ship",
    (("superpixels", "2%"),): "larger superpixels",
    (("superpixels", "8.7%"),): "smaller superpixels",
    (("segmentation", "bass-st"),): "the paper's superpixels (BASS with Shi-Tomasi)",
    (("segmentation", "slic"),): "SLIC superpixels",
    (("budget", "auto"),): "as many Gaussians as the scene needs (`--budget auto`)",
}


def _ablation(parts: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """The counterpart of the paper's ablation."""
    groups = group_runs(parts.get("ablation", ()), lambda r: (r.method, *sorted(r.settings.items())))
    rows = []
    for some in groups.values():
        first = some[0]
        label = ABLATION.get(tuple(sorted(first.settings.items())), describe_run(first))
        name = "the input" if first.method == INPUT else label
        seconds = "" if first.method == INPUT else format_mean(some, "seconds", 1)
        rows.append(
            (name, format_share(some), format_interval(some, "psnr_target_visible"), *format_quality(some)[1:], seconds)
        )
    if not rows:
        return []
    head = ("variant", "kept", "PSNR (dB)", *QUALITY[1:], "seconds")
    return [_section("Ablation", "ablation", "Plain export, all views.", make_table(head, rows))]


def _voxels(parts: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """The counterpart of the paper's table of voxelised input."""
    plain = {r.scene: r for r in parts.get("ablation", ()) if r.method == INPUT}
    records = [r for r in parts.get("anysplat", ()) if r.method in (INPUT, OURS)]
    if not plain or not records:
        return []
    rows = [("unmerged, one per pixel", "100.0 %", *format_quality(list(plain.values())))]
    for some in group_runs(records, lambda r: (r.method != INPUT, r.settings.get("k", 1))).values():
        shares = [r.count / (plain[r.scene].count or 1) for r in some if r.scene in plain and r.count]
        name = "voxelised" if some[0].method == INPUT else f"voxelised, then merged, K = {some[0].settings.get('k', 1)}"
        rows.append((name, f"{100 * np.mean(shares):.1f} %", *format_quality(some)))
    title, words = "Merging a scene that is voxelised already", "Kept is the share of the Gaussians before voxels."
    return [_section(title, "ablation anysplat", words, make_table(("method", "kept", *QUALITY), rows))]


def _proxy(parts: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    if not parts.get("sizes"):
        return []
    words = "Every pixel in the mean colour of its superpixel, PSNR against the photo."
    return [_section("Superpixels alone", "sizes", words, "", "proxy")]


def _scenes(parts: Mapping[str, Sequence[RunRecord]]) -> list[str]:
    """Scene by scene, gsmerge and the input."""
    records = [r for r in parts.get("ablation", ()) if not r.settings and r.method in (INPUT, OURS)]
    before = {r.scene: r for r in records if r.method == INPUT}
    after = {r.scene: r for r in records if r.method == OURS}
    rows = [
        (scene, str(after[scene].views), f"{before[scene].num_input:,}", *format_quality([before[scene]]),
         *format_quality([after[scene]]), format_mean([after[scene]], "seconds", 1))
        for scene in sorted(before) if scene in after
    ]  # fmt: skip
    if not rows:
        return []
    head = (
        "scene",
        "views",
        "Gaussians",
        *(f"{q}, input" for q in QUALITY),
        *(f"{q}, gsmerge" for q in QUALITY),
        "seconds",
    )
    return [_section("Scene by scene", "ablation", "Defaults (K = 1, 4.4 %).", make_table(head, rows))]


def _losing(parts: Mapping[str, Sequence[RunRecord]]) -> str:
    """When not to use it: where results lose against their input, or against fewer Gaussians."""
    gains = sorted(_gains(parts), key=lambda row: float(row[-1]))
    lost = [row for row in gains if float(row[-1]) < 0]
    head = ("scene", "part", "views", "settings", "input (dB)", "gsmerge")
    listed = lost or gains[:5]
    words = "are below their input" if lost else "gain least (none is below its input)"
    text = f"## When not to use it\n\nRuns of gsmerge that {words} on held-out views:\n\n{make_table(head, listed)}"
    return "\n\n".join(filter(None, [text, _too_many(parts.get("sizes", ())), _without(parts.get("ablation", ()))]))


def _gains(parts: Mapping[str, Sequence[RunRecord]]) -> list[Row]:
    """Every run of gsmerge with the PSNR of its input, and how much it is above it."""
    inputs = {(name, r.scene, r.views_asked): r for name, some in parts.items() for r in some if r.method == INPUT}
    rows = []
    for name, some in parts.items():
        for r in some:
            before = inputs.get((name, r.scene, r.views_asked))
            if r.method != OURS or before is None:
                continue
            mine, theirs = r.value("psnr_target_visible"), before.value("psnr_target_visible")
            if mine is None or theirs is None:
                continue
            views = "all" if r.views_asked is None else str(r.views_asked)
            changed = ", ".join(f"{k} {v}" for k, v in r.settings.items()) or "defaults"
            rows.append((r.scene, name, views, changed, f"{theirs:.2f}", f"{mine - theirs:+.2f}"))
    return rows


def _too_many(records: Sequence[RunRecord]) -> str:
    """What a number of Gaussians brings, by scene: where depth or poses are poor, more of them fit what is wrong."""
    runs = [
        r
        for r in records
        if r.method == OURS and set(r.settings) == {"budget"} and r.value("psnr_target_visible") is not None
    ]
    budgets = sorted({str(r.settings["budget"]) for r in runs}, key=lambda text: float(text.rstrip("%")))
    if len(budgets) < 2:
        return ""
    by_scene = {(r.scene, str(r.settings["budget"])): r for r in runs}
    rows = []
    for scene in sorted({r.scene for r in runs}):
        values = [
            (by_scene[scene, b].scores["psnr_target_visible"], by_scene[scene, b].scores["psnr_context"])
            for b in budgets
            if (scene, b) in by_scene
        ]
        rows.append((scene, *(f"{target:.2f} / {context:.2f}" for target, context in values)))
    words = (
        "More Gaussians are not always better. Held-out and input views (dB) by budget: where the input views go on"
        " rising and the held-out ones fall, the photos are learned by heart, because depth or poses do not fit them;"
        " ask for fewer, or for `--budget auto`."
    )
    return f"### More Gaussians than a scene bears\n\n{words}\n\n{make_table(('scene', *budgets), rows)}"


def _without(records: Sequence[RunRecord]) -> str:
    """What is left without photos to fit to."""
    plain = [r for r in records if r.method == OURS and not r.settings]
    learned = {"budget": SHARE, "fit": "none", "checkpoint": "shipped"}
    bare = [r for r in records if r.method == OURS and dict(r.settings) == learned]
    if not (plain and bare):
        return ""
    inputs = [r for r in records if r.method == INPUT]
    without, full, before = (format_mean(some, "psnr_target_visible") for some in (bare, plain, inputs))
    return (
        "### Without photos\n\nWithout photos nothing can be fitted, and the merge alone has to do: at most"
        f" {without} dB instead of {full} dB (the input: {before} dB)."
    )
