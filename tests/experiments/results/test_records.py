"""Records are read back as they were written; a malformed file is one line with a hint."""

from __future__ import annotations

from rse_pf.extensions.experiments.results.records import (
    SampleLog,
    read_samples,
    run_sample,
    sample_from_document,
)

ORIGIN_S = 1000.0


def test_samples_of_the_monitor_are_read_back_as_they_were_written(tmp_path):
    full = {
        "name": "server-1", "pid": 7, "state": "healthy", "robots": 2, "cpu_percent": 71.25, "requests": 5,
        "queue": 1, "queue_ms": 0.5, "in_flight": 1, "bytes_in": 10, "bytes_out": 20, "warming": True,
        "something": "new",
    }  # fmt: skip
    silent = {"name": "server-2", "pid": 8, "state": "starting", "cpu_percent": None}
    reported = {"time": ORIGIN_S + 1.5, "healthy_servers": 1, "servers": [full, silent]}
    readings = [sample_from_document(reported, ORIGIN_S), run_sample(time_s=2.0, healthy_servers=0)]

    with (tmp_path / "samples.csv").open("w", newline="") as file:
        log = SampleLog(file)
        for reading in readings:
            log.write(reading)

    assert read_samples(tmp_path / "samples.csv") == readings
    assert readings[0].time == 1.5
    assert readings[0].servers[0].warming is True
