"""How a demo tells of a merge that runs somewhere else."""

from __future__ import annotations

from rse_pf.experiments.demo.merge_client import tenths


def test_progress_is_a_line_for_each_tenth_and_never_goes_back():
    said: list[str] = []
    tell = tenths(said.append)

    tell(0.0, "waits for its turn")
    tell(0.0, "starts")
    for step in range(100):
        tell(0.1 + 0.007 * step, f"pair {step}")
    tell(0.2, "pair 14 again, elsewhere")
    tell(1.0, "merged")

    assert said[0] == "merging the maps: 0 %, waits for its turn"
    assert [int(line.split()[3]) for line in said] == [0, 10, 20, 30, 40, 50, 60, 70, 100]
    assert said[-1] == "merging the maps: 100 %, merged"
