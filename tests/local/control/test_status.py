"""What the table of ``rse-pf local status`` says about tenants."""

from __future__ import annotations

from typing import Any

from rse_pf.local.control.status import status_table


def status(*taken: dict[str, float]) -> dict[str, Any]:
    process = {"pid": 1, "running": True}
    servers = [{"name": f"s-{n}", "pid": n, "state": "gone"} for n in range(1)]
    servers += [{"name": f"t-{n}", "pid": n, "tenant_cpu_s": each} for n, each in enumerate(taken)]
    return {
        "url": "", "servers": servers, "data_servers": [], "balancer": process, "control_plane": process,
    }  # fmt: skip


def test_the_table_names_the_tenants_that_took_most_over_all_servers():
    many = {f"t{number}": 1.0 + number for number in range(8)}

    table = status_table(status({"acme": 90.0, **many}, {"acme": 10.5, "rival": 50.0}))

    (line,) = [line for line in table.splitlines() if line.startswith("computed for tenants")]
    assert line == "computed for tenants  acme 100.5 s, rival 50.0 s, t7 8.0 s, t6 7.0 s, t5 6.0 s"


def test_the_table_of_a_platform_with_one_tenant_has_no_line_about_tenants():
    assert "tenants" not in status_table(status({"default": 90.0}, {"default": 1.0}))
