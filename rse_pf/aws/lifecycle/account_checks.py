"""Check before a deployment that the account is ready for it: quotas, certificate, bootstrap.

The checks are independent: a check whose call AWS refuses gives a warning, and the others are made
nevertheless.  Nothing is changed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import NamedTuple

from rse_pf.aws.account import Account
from rse_pf.aws.cloudformation import find_foreign_qualifier, list_living_stacks, read_bootstrap_version
from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import zone_count
from rse_pf.config.elasticity import instance_types
from rse_pf.config.resource_names import ResourceNames, toolkit_stack
from rse_pf.errors import ConfigurationError, StoreError

__all__ = ["NOT_BOOTSTRAPPED", "Check", "check_account"]

NOT_BOOTSTRAPPED = "the CDK is not bootstrapped"
"""Beginning of the text of a failed check that ``rse-pf cloud up`` repairs by a bootstrap."""

# Quota of vCPUs of on-demand instances: service and quota code.
_VCPUS_QUOTA = ("ec2", "L-1216C47A")
# Quota of concurrent executions of AWS Lambda: service and quota code.
_EXECUTIONS_QUOTA = ("lambda", "L-B99A9384")
# Quota of VPCs in a region: service and quota code.
_VPCS_QUOTA = ("vpc", "L-F678F1CE")
# Number of concurrent executions of an account that AWS keeps for functions without a reservation.
_ALWAYS_UNRESERVED = 100
# Number of vCPUs of an instance type from ``medium`` to ``large``; a type ``Nxlarge`` has 4 N.
_VCPUS_BELOW_XLARGE = 2
_ASK_FOR_MORE = "ask for more in the Service Quotas console"


class Check(NamedTuple):
    """The result of a check: ``grade`` (ok, warn, fail), the finding ``what``, and its remedy ``fix``."""

    grade: str
    what: str
    fix: str = ""


def check_account(account: Account, settings: PlatformSettings) -> Iterator[Check]:
    """Yield the results of all checks; if AWS refuses or does not answer one, its result is a warning.

    Raises:
        ConfigurationError: AWS does not accept the credentials.
        StoreError: AWS does not answer the first call, which asks who signed in.
    """
    caller = account.find("sts", "get_caller_identity") or {}
    yield Check("ok", f"signed in as {caller.get('Arn', '?')}, region {account.region}")
    checks: tuple[Callable[[Account, PlatformSettings], Check], ...] = (
        _check_bootstrap, _check_certificate, _check_instance_type, _check_vcpus, _check_executions,
        _check_vpcs,
    )  # fmt: skip
    for check in checks:
        try:
            yield check(account, settings)
        except (ConfigurationError, StoreError) as error:
            yield Check("warn", f"not checked: {error.message}", error.hint)


def _check_bootstrap(account: Account, settings: PlatformSettings) -> Check:
    version = read_bootstrap_version(account, settings)
    if version is None and (qualifier := find_foreign_qualifier(account, settings)) is not None:
        stack = toolkit_stack(settings.cloud.bootstrap_qualifier)
        return Check(
            "fail", f"the stack {stack} is a bootstrap of other applications, qualifier {qualifier}",
            f"set cloud.bootstrap_qualifier to {qualifier} to share it, or to a word of your own",
        )  # fmt: skip
    if version is None:
        return Check("fail", f"{NOT_BOOTSTRAPPED} in {account.region}", "rse-pf cloud up does it")
    return Check("ok", f"bootstrapped, version {version}")


def _check_certificate(account: Account, settings: PlatformSettings) -> Check:
    cloud = settings.cloud
    if cloud.allow_insecure:
        return Check(
            "warn",
            "cloud.allow_insecure is true: no TLS",
            "for more than trials, set cloud.allow_insecure to false",
        )
    parts = cloud.certificate_arn.split(":")
    if len(parts) < 6 or parts[2:4] != ["acm", account.region]:
        return Check(
            "fail", f"{cloud.certificate_arn} is no ACM certificate of {account.region}",
            "a load balancer takes certificates of its own region",
        )  # fmt: skip
    answer = account.find("acm", "describe_certificate", CertificateArn=cloud.certificate_arn)
    if answer is None:
        return Check("fail", "there is no such certificate", "fix cloud.certificate_arn")
    certificate = answer["Certificate"]
    names = {certificate["DomainName"], *certificate.get("SubjectAlternativeNames", ())}
    if not any(_covers(name, cloud.domain_name) for name in names):
        return Check(
            "fail", f"the certificate is for {', '.join(sorted(names))}, not for {cloud.domain_name}",
            "order one for cloud.domain_name",
        )  # fmt: skip
    if certificate["Status"] != "ISSUED":
        return Check(
            "fail", f"the certificate is {certificate['Status']}", "add the DNS record that ACM shows"
        )
    return Check("ok", f"certificate for {cloud.domain_name}")


def _covers(name: str, domain: str) -> bool:
    if name.startswith("*."):
        return domain.partition(".")[2] == name[2:]
    return name == domain


def _check_instance_type(account: Account, settings: PlatformSettings) -> Check:
    kinds = instance_types(settings.cloud.instance_type, settings.cloud.other_instance_types)
    rows = account.pages(
        "ec2", "describe_instance_type_offerings", "InstanceTypeOfferings",
        LocationType="availability-zone", Filters=[{"Name": "instance-type", "Values": list(kinds)}],
    )  # fmt: skip
    offered = {(str(row["InstanceType"]), str(row["Location"])) for row in rows}
    rows_of_zones = account.pages("ec2", "describe_availability_zones", "AvailabilityZones")
    # The stacks take the first zones in the order of Fn::GetAZs, which is that of their names.
    zones = sorted(str(row["ZoneName"]) for row in rows_of_zones)[: zone_count(settings)]
    lacking = [f"{kind} in {zone}" for kind in kinds for zone in zones if (kind, zone) not in offered]
    if any(all((kind, zone) not in offered for kind in kinds) for zone in zones):
        return Check("fail", f"AWS does not offer {', '.join(lacking)}", "choose another cloud.instance_type")
    if lacking:
        return Check(
            "warn",
            f"AWS does not offer {', '.join(lacking)}",
            "change cloud.other_instance_types, or accept it",
        )
    return Check("ok", f"{', '.join(kinds)} is offered in {', '.join(zones)}")


def _check_vcpus(account: Account, settings: PlatformSettings) -> Check:
    # One server more: an instance that drains still runs when its replacement starts.
    needed = (settings.scaling.max_servers + 1) * _vcpus_of(settings.cloud.instance_type)
    return _check_quota(
        account, _VCPUS_QUOTA, needed, "vCPUs of on-demand instances for scaling.max_servers and one more"
    )


def _vcpus_of(instance_type: str) -> int:
    size = re.search(r"\.(\d*)xlarge$", instance_type)
    return 4 * int(size[1] or 1) if size else _VCPUS_BELOW_XLARGE


def _check_executions(account: Account, settings: PlatformSettings) -> Check:
    needed = settings.cloud.lambda_concurrency + _ALWAYS_UNRESERVED
    need = f"concurrent executions: cloud.lambda_concurrency, and {_ALWAYS_UNRESERVED} that stay unreserved"
    return _check_quota(account, _EXECUTIONS_QUOTA, needed, need)


def _check_vpcs(account: Account, settings: PlatformSettings) -> Check:
    names = ResourceNames(settings.cloud.name)
    ours = names.stack("Network") in list_living_stacks(account, names)
    there = len(account.pages("ec2", "describe_vpcs", "Vpcs"))
    return _check_quota(account, _VPCS_QUOTA, there + (0 if ours else 1), "VPCs in the region, with this one")


def _check_quota(account: Account, quota: tuple[str, str], needed: int, need: str) -> Check:
    service, code = quota
    query = {"ServiceCode": service, "QuotaCode": code}
    answer = account.find("service-quotas", "get_service_quota", **query)
    if answer is None:  # the account has no quota of its own, so AWS's default applies
        answer = account.find("service-quotas", "get_aws_default_service_quota", **query)
    if answer is None:
        return Check(
            "warn", f"quota {service} {code} cannot be read; needed are {needed} {need}", _ASK_FOR_MORE
        )
    most = float(answer["Quota"]["Value"])
    line = f"quota {most:g}, needed {needed}: {need}"
    return Check("ok", line) if most >= needed else Check("fail", line, _ASK_FOR_MORE)
