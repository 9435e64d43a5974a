"""Workers count, the supervisor adds up, Prometheus can read it."""

from __future__ import annotations

from prometheus_client.parser import text_string_to_metric_families

from rse_pf.server.metrics import (
    MAX_TENANTS,
    OTHER_TENANTS,
    Metrics,
    merge,
    render,
    tenant_cpu_s,
)


def worker(answers: list[tuple[str, str, float]], **gauges: float) -> dict:
    metrics = Metrics()
    for service, result, duration_s in answers:
        metrics.count_answer(service, result, duration_s)
    metrics.shed["behind"] += 1
    metrics.bytes_in += 10
    metrics.gauges = {"robots": 2.0, "queue_oldest_s": 0.0, **gauges}
    return metrics.snapshot()


def test_prometheus_can_parse_the_rendered_text():
    text = render(
        merge([worker([("pnp", "ok", 0.001), ("pnp", "ok", 0.0011), ("pnp", "ok", 60.0)])])
    ).decode()

    families = {family.name: family for family in text_string_to_metric_families(text)}
    buckets = {
        s.labels["le"]: s.value
        for s in families["rse_pf_duration_seconds"].samples
        if s.name.endswith("_bucket")
    }
    assert (buckets["0.001"], buckets["0.002"], buckets["5.0"], buckets["+Inf"]) == (1, 2, 2, 3)
    assert [s.value for s in families["rse_pf_shed"].samples if s.name == "rse_pf_shed_total"] == [1]


def test_what_was_computed_for_each_tenant_is_added_up_over_workers_and_kinds():
    first, second = Metrics(), Metrics()
    first.count_answer("pnp", "ok", 0.3, "acme", 0.25)
    first.count_answer("pnp", "no-consensus", 0.6, "acme", 0.5)
    first.set_cpu("jobs", {"acme": 2.0, "rival": 1.0})
    first.set_cpu("jobs", {"acme": 3.0, "rival": 1.0})
    second.count_answer("pnp", "ok", 0.2, "rival", 0.125)
    merged = merge([first.snapshot(), second.snapshot()])

    families = {each.name: each for each in text_string_to_metric_families(render(merged).decode())}
    samples = {
        (sample.labels["tenant"], sample.labels["kind"]): sample.value
        for sample in families["rse_pf_tenant_cpu_seconds"].samples
        if sample.name.endswith("_total")
    }
    assert samples == {
        ("acme", "commands"): 0.75, ("acme", "jobs"): 3.0,
        ("rival", "commands"): 0.125, ("rival", "jobs"): 1.0,
    }  # fmt: skip
    assert list(tenant_cpu_s(merged).items()) == [("acme", 3.75), ("rival", 1.125)]


def test_many_tenants_are_counted_as_others_and_nothing_is_lost():
    metrics = Metrics()
    for _ in range(2):
        for number in range(3 * MAX_TENANTS):
            metrics.count_answer("pnp", "ok", 1.0, f"t{number}", 1.0)
    metrics.set_cpu("jobs", {f"t{number}": 1.0 for number in range(3 * MAX_TENANTS)})

    merged = merge([metrics.snapshot()])

    assert len(merged["tenant_cpu_s"]) == 2 * (MAX_TENANTS + 1)
    taken = tenant_cpu_s(merged)
    assert sum(taken.values()) == 9 * MAX_TENANTS
    assert taken[OTHER_TENANTS] == 6 * MAX_TENANTS
