"""What an account must have before a deployment: each check alone, with what to do when it fails."""

from __future__ import annotations

import json
from typing import Any

import pytest

from rse_pf.aws.account import Account
from rse_pf.aws.clients import make_client
from rse_pf.aws.lifecycle.account_checks import NOT_BOOTSTRAPPED, Check, check_account
from rse_pf.config import PlatformSettings

SETTINGS = PlatformSettings()


class Quotas:
    """Service quotas as an account has them; moto knows few."""

    def __init__(self, **values: float) -> None:
        self.values = values

    def _asked(self, code: str) -> dict[str, Any]:
        from botocore.exceptions import ClientError

        if code not in self.values:
            raise ClientError({"Error": {"Code": "NoSuchResourceException"}}, "GetServiceQuota")
        return {"Quota": {"Value": self.values[code]}}

    def get_service_quota(self, *, ServiceCode: str, QuotaCode: str) -> dict[str, Any]:
        return self._asked(QuotaCode.replace("-", "_"))

    def get_aws_default_service_quota(self, *, ServiceCode: str, QuotaCode: str) -> dict[str, Any]:
        return self._asked("default_" + QuotaCode.replace("-", "_"))


AMPLE = Quotas(L_1216C47A=22, L_B99A9384=1000, default_L_F678F1CE=5)


def account(region: str, quotas: Quotas = AMPLE) -> Account:
    return Account(region, lambda name, at: quotas if name == "service-quotas" else make_client(name, at))


def checks(region: str, settings: PlatformSettings = SETTINGS, quotas: Quotas = AMPLE) -> list[Check]:
    return list(check_account(account(region, quotas), settings))


def only(word: str, found: list[Check]) -> Check:
    (check,) = [each for each in found if word in each.what]
    return check


def bootstrap(region: str) -> None:
    make_client("ssm", region).put_parameter(
        Name="/cdk-bootstrap/hnb659fds/version", Value="28", Type="String"
    )


def public(certificate: str, domain: str = "robots.example.org") -> PlatformSettings:
    return SETTINGS.replace(
        cloud={"allow_insecure": False, "certificate_arn": certificate, "domain_name": domain}
    )


def test_an_account_with_room_is_ready_and_every_complaint_has_a_fix(region: str) -> None:
    bootstrap(region)

    found = checks(region)

    assert [each for each in found if each.grade == "fail"] == []
    assert only("signed in", found).grade == "ok"
    assert only("bootstrapped, version 28", found).grade == "ok"
    assert only("c7i.large is offered", found).grade == "ok"
    assert only("quota 22, needed 22", found).grade == "ok"
    assert all(bool(each.fix) == (each.grade != "ok") for each in found)


def test_an_account_without_bootstrap_gets_the_command(region: str) -> None:
    check = only("bootstrap", checks(region))

    assert (check.grade, check.fix) == ("fail", "rse-pf cloud up does it")


def test_a_bootstrap_never_changes_the_stack_of_another_qualifier(region: str) -> None:
    template = {
        "Parameters": {"Qualifier": {"Type": "String"}},
        "Resources": {"Log": {"Type": "AWS::Logs::LogGroup"}},
    }
    make_client("cloudformation", region).create_stack(
        StackName="CDKToolkit", TemplateBody=json.dumps(template),
        Parameters=[{"ParameterKey": "Qualifier", "ParameterValue": "theirs"}],
    )  # fmt: skip

    check = only("CDKToolkit", checks(region))
    own = only("bootstrap", checks(region, SETTINGS.replace(cloud={"bootstrap_qualifier": "lab1"})))

    assert check.grade == "fail"
    assert "qualifier theirs" in check.what
    assert not check.what.startswith(NOT_BOOTSTRAPPED), "rse-pf cloud up must not bootstrap"
    assert own.what.startswith(NOT_BOOTSTRAPPED)


@pytest.mark.parametrize(
    ("kind", "needed"), [("c7i.large", 22), ("t3.medium", 22), ("z1d.xlarge", 44), ("z1d.4xlarge", 176)]
)
def test_too_few_vcpus_for_the_largest_fleet_fail(region: str, kind: str, needed: int) -> None:
    settings = SETTINGS.replace(cloud={"instance_type": kind})
    check = only("vCPUs", checks(region, settings, Quotas(L_1216C47A=21)))

    assert check.grade == "fail"
    assert check.what.startswith(f"quota 21, needed {needed}")


def test_an_instance_type_that_the_region_lacks_fails(region: str) -> None:
    found = checks(region, SETTINGS.replace(cloud={"instance_type": "x99.huge"}))

    assert (
        only("does not offer x99.huge in ap-northeast-2a, x99.huge in ap-northeast-2b", found).grade == "fail"
    )


def test_a_type_that_one_zone_lacks_fails_unless_another_type_is_there(region: str) -> None:
    class Zones:
        """moto offers every type in every zone."""

        def can_paginate(self, method: str) -> bool:
            return False

        def describe_availability_zones(self) -> dict[str, Any]:
            return {"AvailabilityZones": [{"ZoneName": f"{region}{letter}"} for letter in "abc"]}

        def describe_vpcs(self) -> dict[str, Any]:
            return {"Vpcs": []}

        def describe_instance_type_offerings(self, **asked: Any) -> dict[str, Any]:
            assert asked["LocationType"] == "availability-zone"
            rows = [("c7i.large", "a"), ("c7i.large", "c"), ("c6i.large", "a"), ("c6i.large", "b")]
            wanted = asked["Filters"][0]["Values"]
            return {
                "InstanceTypeOfferings": [
                    {"InstanceType": kind, "Location": f"{region}{zone}"}
                    for kind, zone in rows
                    if kind in wanted
                ]
            }

    def told(cloud: dict[str, str]) -> Check:
        made: dict[str, Any] = {"ec2": Zones(), "service-quotas": AMPLE}
        of = Account(region, lambda name, at: made.get(name) or make_client(name, at))
        checks = list(check_account(of, SETTINGS.replace(cloud=cloud)))
        return next(each for each in checks if "large" in each.what)

    alone, both = told({}), told({"other_instance_types": "c6i.large"})

    assert (alone.grade, alone.what) == ("fail", f"AWS does not offer c7i.large in {region}b")
    assert both.grade == "warn"


def test_a_service_that_does_not_answer_is_a_warning_without_a_page_of_html(region: str) -> None:
    from botocore.exceptions import ClientError

    class Broken(Quotas):
        def get_service_quota(self, *, ServiceCode: str, QuotaCode: str) -> dict[str, Any]:
            page = {"Code": "502", "Message": "<html><body>Bad Gateway</body></html>"}
            raise ClientError({"Error": page, "ResponseMetadata": {"HTTPStatusCode": 502}}, "GetServiceQuota")

    found = checks(region, quotas=Broken())

    assert [each.grade for each in found[-3:]] == ["warn"] * 3
    assert all(each.what == "not checked: AWS does not answer: HTTP status 502" for each in found[-3:])


def test_the_certificate_must_be_there_issued_of_the_region_and_for_the_name(region: str) -> None:
    acm = make_client("acm", region)
    arn = acm.request_certificate(DomainName="*.example.org")["CertificateArn"]
    elsewhere = arn.replace(region, "us-east-1")
    absent = arn[:-4] + "0000"

    told = [
        only("certificate", checks(region, public(certificate, domain)))
        for certificate, domain in (
            (arn, "robots.example.org"), (arn, "robots.example.com"), (arn, "a.b.example.org"),
            (elsewhere, "robots.example.org"), (absent, "robots.example.org"),
        )
    ]  # fmt: skip

    assert "not for robots.example.com" in told[1].what
    assert "not for a.b.example.org" in told[2].what
    assert f"no ACM certificate of {region}" in told[3].what
    assert "no such certificate" in told[4].what
    assert [each.grade for each in told[1:]] == ["fail"] * 4
    status = acm.describe_certificate(CertificateArn=arn)["Certificate"]["Status"]
    assert (told[0].grade == "ok") == (status == "ISSUED")


def test_a_check_that_may_not_be_made_warns_and_the_next_follows(region: str) -> None:
    from botocore.exceptions import ClientError

    class Closed(Quotas):
        def get_service_quota(self, *, ServiceCode: str, QuotaCode: str) -> dict[str, Any]:
            raise ClientError({"Error": {"Code": "AccessDenied"}}, "GetServiceQuota")

    found = checks(region, quotas=Closed())

    assert [each.grade for each in found[-3:]] == ["warn"] * 3
    assert all("AccessDenied" in each.what for each in found[-3:])
