"""What the buckets keep and for how long, what is copied elsewhere, and how servers reach live maps."""

from __future__ import annotations

from typing import Any

import pytest

from rse_pf.auth.trust_store import DENY_NAME, ROBOTS_NAME
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import KEYS_NAME, SERVICES_PREFIX
from rse_pf.config.settings import LIVE_PORTS

Assembly = Any
READ_LIKE_ANY_OBJECT = {"STANDARD_IA", "GLACIER_IR"}
"""Storage classes from which S3 answers a GET at once; from GLACIER and DEEP_ARCHIVE it does not."""


def buckets(assembly: Assembly) -> dict[str, dict[str, Any]]:
    """Return the properties of each bucket by its name in the data stack."""
    resources = assembly.templates["RsePf-Data"]["Resources"]
    return {
        name[:-8]: each["Properties"] for name, each in resources.items() if each["Type"] == "AWS::S3::Bucket"
    }


def rules(bucket: dict[str, Any]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = bucket["LifecycleConfiguration"]["Rules"]
    assert all(each["Status"] == "Enabled" for each in found)
    return found


def test_no_rule_makes_a_map_unreadable_that_robots_still_use(assembly: Assembly) -> None:
    """Objects are named by digest: old keyframes of a map that grows every day are never written again."""
    moved = {
        transition["StorageClass"]: transition["TransitionInDays"]
        for bucket in buckets(assembly).values()
        for rule in rules(bucket)
        for transition in rule.get("Transitions", [])
    }

    assert set(moved) == READ_LIKE_ANY_OBJECT
    assert moved["GLACIER_IR"] == 90 > moved["STANDARD_IA"]


def test_what_nobody_can_see_is_deleted_in_every_bucket(assembly: Assembly) -> None:
    """Parts of uploads that were given up, and former versions: S3 lists neither, and both cost money."""
    kept = {"AccessLogs": 1, "AuditLogs": 1, "Maps": 30, "Artifacts": 30}

    assert buckets(assembly).keys() == kept.keys()
    for name, bucket in buckets(assembly).items():
        aborted = [each["AbortIncompleteMultipartUpload"] for each in rules(bucket) if "Abort" in str(each)]
        former = [
            each["NoncurrentVersionExpiration"]["NoncurrentDays"]
            for each in rules(bucket)
            if "NoncurrentVersionExpiration" in each and "Prefix" not in each
        ]
        assert aborted == [{"DaysAfterInitiation": 1}], name
        assert former == [kept[name]], name


def test_an_identity_and_maps_are_copied_to_other_regions_and_nothing_else(assembly: Assembly) -> None:
    copied = {
        name: [
            (rule["Destination"]["Bucket"]["Fn::Join"][1][-1], rule["Filter"]["Prefix"])
            for rule in bucket["ReplicationConfiguration"]["Rules"]
        ]
        for name, bucket in buckets(assembly).items()
        if "ReplicationConfiguration" in bucket
    }
    if not assembly.settings.cloud.replica_maps:
        assert copied == {}
        return

    artifacts = ":s3:::artifacts-in-virginia"
    assert copied == {
        "Artifacts": [
            (artifacts, KEYS_NAME), (artifacts, "control/"), (artifacts, f"{SERVICES_PREFIX}/"),
        ],
        "Maps": [(":s3:::maps-in-virginia", "maps/"), (":s3:::maps-in-ireland", "maps/")],
    }  # fmt: skip
    prefixes = tuple(prefix for _, prefix in copied["Artifacts"])
    assert all(name.startswith(prefixes) for name in (KEYS_NAME, ROBOTS_NAME, DENY_NAME))
    for bucket in buckets(assembly).values():
        found = bucket.get("ReplicationConfiguration", {"Rules": []})["Rules"]
        assert len({rule["Priority"] for rule in found}) == len({rule["Id"] for rule in found}) == len(found)


def test_servers_reach_live_maps_on_each_other_and_nothing_else_does(assembly: Assembly) -> None:
    live = assembly.settings.live
    ports = (live.first_port, live.first_port + LIVE_PORTS - 1)
    resources = assembly.templates["RsePf-Network"]["Resources"]
    (servers,) = [name for name in resources if name.startswith("FirewallServers") and len(name) == 23]
    allowed = {"AWS::EC2::SecurityGroupIngress": [], "AWS::EC2::SecurityGroupEgress": []}  # type: dict[str, list[Any]]
    for each in resources.values():
        rule = each["Properties"]
        if each["Type"] in allowed and (rule["FromPort"], rule["ToPort"]) == ports:
            sides = [rule[name]["Fn::GetAtt"][0] for name in rule if name.endswith("GroupId")]
            allowed[each["Type"]].append((rule["IpProtocol"], *sides))

    assert allowed == {
        "AWS::EC2::SecurityGroupIngress": [("tcp", servers, servers)],
        "AWS::EC2::SecurityGroupEgress": [("tcp", servers, servers)],
    }
    entries = [
        (each.get("Egress", False), each["CidrBlock"], each["RuleAction"])
        for each in assembly.all("AWS::EC2::NetworkAclEntry")
        if (each.get("PortRange") or {}) == {"From": ports[0], "To": ports[1]}
    ]
    assert entries == [(False, {"Fn::GetAtt": [_vpc(resources), "CidrBlock"]}, "allow")]


def _vpc(resources: dict[str, Any]) -> str:
    (name,) = [name for name, each in resources.items() if each["Type"] == "AWS::EC2::VPC"]
    return name


@pytest.mark.parametrize(
    ("groups", "has_ports"),
    [({}, True), ({"data": {"enabled": False}}, False), ({"live": {"max_owners": 0}}, False)],
)
def test_without_live_maps_no_port_is_open_between_servers(groups: Any, has_ports: bool) -> None:
    pytest.importorskip("aws_cdk", reason="run make setup")
    from stacks.firewall import live_range

    assert (live_range(PlatformSettings.from_dict(groups)) is not None) == has_ports
