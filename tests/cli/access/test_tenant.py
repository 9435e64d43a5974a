"""Tenants on the command line: the list of them, and quotas that the data service applies."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.storage import S3Store
from rse_pf.cli.main import main
from rse_pf.storage.object_store import DirectoryStore, ObjectStore, digest_of
from tests.kit.fake_data_service import Service, small_settings

Capture = pytest.CaptureFixture[str]
MIB = 1 << 20
DEFAULT_QUOTA = 107374182400
SETTING = "data.tenant_quota_bytes"


@pytest.fixture
def store(platform: Path) -> DirectoryStore:
    """The objects of the platform, which has stored nothing yet."""
    return DirectoryStore(platform / "objects")


def output_of(capsys: Capture, words: str) -> str:
    assert main(words.split()) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def enrol(capsys: Capture, name: str, tenant: str) -> None:
    key = f"{tenant}-{name}"
    Path(f"{key}.json").write_text(output_of(capsys, f"robot keygen --out {key}.key"))
    output_of(capsys, f"robot enrol {name} --public-key {key}.json --tenant {tenant}")


def put(service: Service, data: bytes, tenant: str) -> Any:
    return service.ask("PUT", f"/data/v1/objects/{digest_of(data)}", data, robot="r", tenant=tenant)


def listed(capsys: Capture, options: str = "") -> dict[str, dict[str, Any]]:
    rows = json.loads(output_of(capsys, f"tenant list --json {options}"))
    return {row.pop("tenant"): row for row in rows}


def test_the_list_has_every_tenant_with_robots_or_data(capsys: Capture, store: DirectoryStore) -> None:
    enrol(capsys, "robot-1", "acme")
    enrol(capsys, "robot-2", "acme")
    enrol(capsys, "robot-1", "Lab_7")
    store.put("maps/acme/hall/blobs/1", bytes(MIB))
    store.put("objects/beta/r/1", b"x")

    assert listed(capsys) == {
        "Lab_7": {"robots": 1, "stored_bytes": 0, "quota_bytes": DEFAULT_QUOTA, "quota_from": SETTING},
        "acme": {"robots": 2, "stored_bytes": MIB, "quota_bytes": DEFAULT_QUOTA, "quota_from": SETTING},
        "beta": {"robots": 0, "stored_bytes": 4096, "quota_bytes": DEFAULT_QUOTA, "quota_from": SETTING},
    }
    output_of(capsys, "tenant quota acme --quota data_bytes=2e6")
    assert output_of(capsys, "tenant list").splitlines() == [
        "tenant  robots  stored_bytes  quota_bytes   quota_from",
        "Lab_7   1       0             107374182400  data.tenant_quota_bytes",
        "acme    2       1048576       2000000       own",
        "beta    0       4096          107374182400  data.tenant_quota_bytes",
    ]


def check_quotas_at_once(capsys: Capture, store: ObjectStore, options: str = "") -> None:
    """Lower, raise and remove the quota of a tenant while a data service runs."""
    settings = small_settings(quota_bytes=1 << 30, tenant_quota_bytes=60_000, part_bytes=MIB)
    service = Service(settings, store)
    assert put(service, bytes(50_000), "acme").status == 201
    refused = put(service, bytes(50_001), "acme")
    assert (refused.status, refused.json["code"]) == (413, "quota")
    assert "above data.tenant_quota_bytes 60000" in refused.json["message"]
    assert "rse-pf tenant quota acme --quota" in refused.json["hint"]

    output_of(capsys, f"tenant quota acme --quota data_bytes=110000 {options}")

    assert put(service, bytes(50_001), "acme").status == 201
    refused = put(service, bytes(50_002), "acme")
    assert "above its own quota 110000" in refused.json["message"]
    assert listed(capsys, options)["acme"]["quota_bytes"] == 110_000
    assert put(service, bytes(50_000), "beta").status == 201
    assert put(service, bytes(50_001), "beta").status == 413, "the quota is that of another tenant"
    output_of(capsys, f"tenant quota acme --quota data_bytes=default {options}")
    assert "above data.tenant_quota_bytes" in put(service, bytes(50_002), "acme").json["message"]


def test_a_quota_of_one_tenant_holds_at_once(capsys: Capture, store: DirectoryStore) -> None:
    check_quotas_at_once(capsys, store)


def test_a_quota_of_one_tenant_of_a_cloud_holds_at_once(capsys: Capture, cloud: Any) -> None:
    assert main(["token", "init", "--cloud"]) == 0
    capsys.readouterr()

    check_quotas_at_once(capsys, S3Store(cloud, "maps"), "--cloud")


@pytest.mark.parametrize(
    ("words", "first"),
    [
        ("tenant quota", "arguments are required: TENANT, --quota"),
        ("tenant quota acme", "arguments are required: --quota"),
        ("tenant list acme", "unrecognized arguments: acme"),
        ("tenant list --quota data_bytes=1", "unknown option --quota"),
        ("tenant quota acmee --quota data_bytes=1e6", "there is no tenant 'acmee'"),
        ("tenant quota acme --quota data_bytes=much", "'data_bytes=much' is not a quota"),
        ("tenant quota acme --quota data_bytes=inf", "is not a finite number above 0"),
        ("tenant quota acme --quota data_bytes=0", "is not a finite number above 0"),
        ("tenant quota acme --quota bytes=default", "'bytes' is not a quota"),
        ("tenant list --name nowhere", "no platform"),
        ("robot quota robot-1 --tenant acme", "arguments are required: --quota"),
        ("robot quota robot-1 --quota data_bytes=5", "is of tenant 'acme', and not of 'default'"),
    ],
)
def test_bad_input_is_one_line_and_a_hint(
    capsys: Capture, store: DirectoryStore, words: str, first: str
) -> None:
    enrol(capsys, "robot-1", "acme")

    assert main(words.split()) == 2

    problem, hint = capsys.readouterr().err.splitlines()
    assert first in problem
    assert "hint" in hint
    assert not list(store.list("quotas/"))
