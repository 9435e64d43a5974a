"""A report is computed again from its records; edited records, edited reports and broken invariants show."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.paper.verify import broken_invariants, figures_of, run_folders, verify
from rse_pf.extensions.experiments.results.records import (
    CommandRecord,
    EventLog,
    SampleLog,
    read_records,
    run_sample,
    write_commands,
)
from rse_pf.extensions.experiments.results.result_folder import write_json
from rse_pf.local.control.monitor import ServerSample

ORIGIN_S = 1000.0


def command(number, planned, **more):
    fields = {
        "id": number, "robot": f"robot-{number % 3}", "planned": planned, "sent": planned + 0.001,
        "answered": planned + 0.02, "server": "server-1", "code": "ok", "round_trip_ms": 20.0,
        "compute_ms": 0.4, "queue_ms": 0.1, "up_ms": 0.2, "down_ms": 0.2,
    }  # fmt: skip
    return CommandRecord(**{**fields, **more})


def server(cpu, name="server-1"):
    return ServerSample(name=name, pid=7, state="healthy", robots=3, cpu_percent=cpu)


@pytest.fixture
def run(tmp_path):
    """A small elasticity run, reported truly."""
    commands = [command(number, number / 5) for number in range(50)]
    write_commands(tmp_path / "commands.csv", commands)
    with (tmp_path / "events.jsonl").open("w") as file:
        log = EventLog(file)
        log.write(
            0.0, "experiment", kind="elasticity", robots=3, fps=5.0, min_servers=1, period_s=2.0,
            busy_periods=2, busy_cpu_percent=70.0, origin_s=ORIGIN_S,
        )  # fmt: skip
        log.write(0.0, "phase", phase="joining")
        log.write(6.05, "grow", servers=1, reason="CPU at 90 %")
        log.write(9.0, "shrink", servers=1, reason="idle")
    with (tmp_path / "samples.csv").open("w", newline="") as file:
        log = SampleLog(file)
        for step in range(1, 20):
            cpu = 90.0 if step > 4 else 30.0
            log.write(
                run_sample(time_s=step / 2, healthy_servers=1, servers=(server(cpu), server(cpu, "server-2")))
            )
    write_report(tmp_path)
    return tmp_path


def write_report(folder):
    write_json(folder / "report.json", {"experiment": "elasticity", **figures_of(read_records(folder))})


def differing(folder):
    return [finding.what for finding in verify(folder) if not finding.agrees]


def edit(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_true_report_agrees_in_every_figure(run):
    findings = verify(run)

    assert all(finding.agrees for finding in findings)
    names = {finding.what for finding in findings}
    assert {"scale_outs", "commands/lost", "round_trip_ms/p99", "cpu_percent_series"} <= names
    assert "invariant: every scale-out follows the required busy samples" in names


def test_an_edited_report_differs(run):
    report = json.loads((run / "report.json").read_text())
    report["round_trip_ms"]["p99"] -= 1.0
    report["commands"]["failed"] = 3
    write_json(run / "report.json", report)

    assert differing(run) == ["commands/failed", "round_trip_ms/p99"]


def test_an_edited_command_differs(run):
    rows = (run / "commands.csv").read_text().splitlines()
    rows[5] = rows[5].replace(",ok,", ",busy,")
    (run / "commands.csv").write_text("\n".join(rows) + "\n")

    assert {"commands/answered", "commands/failed"} <= set(differing(run))


def test_a_round_trip_that_contradicts_its_time_stamps_breaks_an_invariant(run):
    edit(run / "commands.csv", ",20.0,", ",2.0,")
    write_report(run)

    assert differing(run) == [
        "invariant: no command is answered before it is sent, and a round trip is what its time stamps say"
    ]


def test_a_scale_out_that_the_samples_do_not_justify_breaks_the_invariant(run):
    text = (run / "samples.csv").read_text()
    (run / "samples.csv").write_text(text.replace("90.0", "60.0"))
    write_report(run)

    assert differing(run) == ["invariant: every scale-out follows the required busy samples"]


def test_a_lost_command_and_a_second_answer_break_invariants(run):
    records = read_records(run)
    lost = replace(records.commands[0], code="", answered=None, server="", round_trip_ms=None)
    again = records.commands[1]
    write_commands(run / "commands.csv", [lost, *records.commands[1:], again])
    write_report(run)

    broken = {name for name, what in broken_invariants(read_records(run)).items() if what}
    assert broken == {"every command came to an end", "no answer was delivered twice"}


def test_every_run_of_a_folder_is_verified_by_its_name(run, tmp_path):
    whole = tmp_path / "whole"
    whole.mkdir()
    for name in ("first", "second"):
        (whole / name).mkdir()
        for file in ("commands.csv", "events.jsonl", "samples.csv"):
            (whole / name / file).write_bytes((run / file).read_bytes())
    runs = {name: figures_of(read_records(part)) for name, part in run_folders(whole).items()}
    write_json(whole / "report.json", {"runs": {**runs, "third": runs["first"]}})
    edit(whole / "second" / "samples.csv", "90.0", "10.0")

    assert differing(whole) == ["second: cpu_percent_series", "third: run"]


@pytest.mark.parametrize("name", ["commands.csv", "events.jsonl", "samples.csv", "report.json"])
def test_a_malformed_file_is_one_line_not_a_traceback(run, name):
    (run / name).write_text("time,nonsense\n1,{{\n")
    with pytest.raises(UsageError, match=r"cannot read|is not a report"):
        verify(run)


def test_the_targets_of_a_fault_are_verified_too(run):
    events = (run / "events.jsonl").read_text().splitlines()
    asked = {**json.loads(events[0]), "kind": "robustness", "scenario": "kill"}
    (run / "events.jsonl").write_text("\n".join([json.dumps(asked), *events[1:]]) + "\n")
    write_report(run)
    assert differing(run) == []

    report = json.loads((run / "report.json").read_text())
    report["bars"]["replaced_in_s"]["held"] = True
    write_json(run / "report.json", report)
    assert differing(run) == ["bars/replaced_in_s/held"]
