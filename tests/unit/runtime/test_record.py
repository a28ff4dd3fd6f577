"""The ambient record has what each run wrote, with nothing lost or counted twice."""

from __future__ import annotations

import threading

import pytest

from gsmerge.runtime.record import (
    BEFORE_FIT,
    STAGES,
    Forecast,
    RunPart,
    adopt,
    current_record,
    note,
    record_choices,
    record_part,
    record_run,
    report_progress,
    stage,
)


def test_nothing_is_recorded_outside_of_a_run() -> None:
    with stage("fit"):
        note("lost")
        record_choices(count=1)
    assert current_record().notes == []
    assert current_record().seconds == {}


def test_stages_notes_and_choices_go_to_the_current_run() -> None:
    @stage("encode")
    def encode() -> int:
        note("odd")
        record_choices(groups=3)
        return 3

    events: list[tuple[str, int, int]] = []
    with record_run(lambda *event: events.append(event)) as record:
        assert encode() == encode() == 3
        report_progress("fit: step", 1, 2)
    assert list(record.seconds) == ["encode"]
    assert record.notes == ["odd"]
    assert record.choices == {"groups": 3}
    count = len(STAGES)
    assert events == [("encode", STAGES.index("encode"), count), ("fit: step", 1, 2), ("done", count, count)]


def test_a_stage_inside_another_is_part_of_it() -> None:
    with record_run() as record, stage("prepare"), stage("segment"):
        pass
    assert list(record.seconds) == ["prepare"]


def test_a_new_stage_needs_no_list() -> None:
    events: list[tuple[str, int, int]] = []
    with record_run(lambda *event: events.append(event)) as record:
        with stage("match"):
            pass
        with stage("a new one"):
            pass
    assert list(record.seconds) == ["match", "a new one"]
    assert events[1] == ("a new one", STAGES.index("match") + 1, len(STAGES))


def test_failed_stage_ends_before_the_next_begins() -> None:
    with record_run() as record:
        with pytest.raises(KeyError), stage("prepare"):
            raise KeyError
        with stage("segment"):
            pass
    assert list(record.seconds) == ["prepare", "segment"]


def test_a_part_has_a_record_of_its_own_until_it_is_adopted() -> None:
    events: list[str] = []
    with record_run(lambda text, *_: events.append(text)) as record:
        note("first")
        with record_part() as part, stage("fit"):
            note("second")
            record_choices(steps=2)
        with record_part(silent=True), stage("decode"):
            pass
        assert record.notes == ["first"]
        assert record.seconds == {}
        adopt(part)
    assert record.notes == ["first", "second"]
    assert record.choices == {"steps": 2}
    assert events == ["fit", "done"]


def test_threads_of_the_caller_have_runs_of_their_own() -> None:
    notes: list[list[str]] = []

    def run() -> None:
        with record_run() as own:
            note("other")
        notes.append(own.notes)

    with record_run() as record:
        thread = threading.Thread(target=run)
        thread.start()
        thread.join()
    assert record.notes == []
    assert notes == [["other"]]


def test_forecast_tells_the_share_done_from_parts_and_steps_of_fits() -> None:
    forecast, shares = Forecast(), []
    assert forecast.share is None
    forecast.parts = [
        RunPart("build", 20, 80),
        RunPart("build", 10, 90),
        RunPart("build", 0, 100),
        RunPart("input", 50),
    ]
    for steps in ((1, 50, 100), (1, 100)):
        forecast.begin("build")
        for step in steps:
            forecast.take_step(step, 100)
            shares.append(forecast.share)
    done = [20 * BEFORE_FIT + share * 80 for share in (0.01, 0.5, 1.0)]
    done += [100 + 10 * BEFORE_FIT + share * 90 for share in (0.01, 1.0)]
    assert shares == pytest.approx([work / 350 for work in done])


def test_forecast_leaves_out_parts_that_a_run_did_not_need() -> None:
    forecast = Forecast([RunPart("build", 50), RunPart("build", 50), RunPart("input", 100)])
    forecast.begin("build")
    forecast.begin("input")  # the search has ended before it was expected to
    assert forecast.share == pytest.approx(50 / 150)


def test_forecast_does_not_fall_in_parts_and_fits_that_were_not_expected() -> None:
    forecast = Forecast([RunPart("build", 20, 80)])
    forecast.begin("build")
    forecast.take_step(100, 100)
    share = forecast.share
    forecast.take_step(1, 100)  # of a second fit
    assert forecast.share == share
    for _ in range(2):
        forecast.begin("build")
        assert forecast.share == 1
