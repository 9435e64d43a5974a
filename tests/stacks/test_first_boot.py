"""The boot script: its signature, what it refuses to install, and how little script Amazon allows."""

from __future__ import annotations

import configparser
import hashlib
import io
import shutil
import zipfile
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest

from lambda_pnp.keys import signed_request
from rse_pf.config import PlatformSettings
from stacks.boot.first_boot import fetched, signed_headers, verified
from stacks.boot.install import environment_file

NOW = datetime(2026, 11, 21, 6, 0, 0, tzinfo=timezone.utc)
USER_DATA_BYTES = 16384
FACTS = {
    "server": "i-0abc", "bucket": "artifacts", "keys": "keys.json", "group": "rse-pf", "hook": "drain",
    "launch": "launch", "store": "s3:maps", "audit": "audit-logs",
}  # fmt: skip


def test_the_boot_script_signs_as_the_function_does() -> None:
    theirs = signed_request(
        {
            "RSE_PF_KEYS": "artifacts/keys.json", "AWS_REGION": "ap-northeast-2", "AWS_ACCESS_KEY_ID": "AKID",
            "AWS_SECRET_ACCESS_KEY": "secret", "AWS_SESSION_TOKEN": "session",
        },
        NOW,
    )  # fmt: skip
    credentials = {"AccessKeyId": "AKID", "SecretAccessKey": "secret", "Token": "session"}

    ours = signed_headers(
        "artifacts.s3.ap-northeast-2.amazonaws.com", "/keys.json", "ap-northeast-2", credentials, NOW
    )

    assert ours["authorization"] == theirs.get_header("Authorization")


def test_the_call_that_abandons_a_launch_is_signed_as_the_sdk_does(monkeypatch: pytest.MonkeyPatch) -> None:
    from botocore import auth
    from botocore.awsrequest import AWSRequest
    from botocore.credentials import Credentials

    host, query = "autoscaling.ap-northeast-2.amazonaws.com", "Action=CompleteLifecycleAction&InstanceId=i-1"
    ours = signed_headers(
        host, f"/?{query}", "ap-northeast-2",
        {"AccessKeyId": "AKID", "SecretAccessKey": "secret", "Token": "session"}, NOW, "autoscaling",
    )  # fmt: skip
    digest = {"X-Amz-Content-SHA256": ours["x-amz-content-sha256"], "host": host}
    request = AWSRequest(method="GET", url=f"https://{host}/?{query}", headers=digest)

    monkeypatch.setattr(auth, "get_current_datetime", lambda: NOW)
    auth.SigV4Auth(Credentials("AKID", "secret", "session"), "autoscaling", "ap-northeast-2").add_auth(
        request
    )

    assert ours["authorization"] == request.headers["Authorization"]


def test_the_script_with_its_facts_fits_into_the_user_data(assembly: Any) -> None:
    data = assembly.one("AWS::EC2::LaunchTemplate")["LaunchTemplateData"]["UserData"]["Fn::Base64"]
    parts = data["Fn::Join"][1]
    length = sum(len(part) if isinstance(part, str) else 128 for part in parts)

    assert length < USER_DATA_BYTES


def test_a_boot_asks_hosts_of_the_partition_of_its_region(
    assembly: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    hosts: list[str] = []

    def answer(request: Any, **_: Any) -> io.BytesIO:
        hosts.append(request.host)
        if request.full_url.endswith("/role"):
            return io.BytesIO(b'{"AccessKeyId": "a", "SecretAccessKey": "b", "Token": "c"}')
        return io.BytesIO(b"role")

    monkeypatch.setattr("urllib.request.urlopen", answer)
    fetched({"package": "s3://assets/boot.zip", "region": "cn-north-1", "domain": "amazonaws.com.cn"})

    assert "assets.s3.cn-north-1.amazonaws.com.cn" in hosts
    data = assembly.one("AWS::EC2::LaunchTemplate")["LaunchTemplateData"]["UserData"]["Fn::Base64"]
    assert {"Ref": "AWS::URLSuffix"} in data["Fn::Join"][1]


def packed(files: dict[str, bytes], listed: dict[str, bytes] | None = None) -> tuple[bytes, str]:
    """Return a package and the digest of its list; *listed* is what the list was made of."""
    sums = "".join(
        f"{hashlib.sha256(data).hexdigest()}  {name}\n"
        for name, data in (files if listed is None else listed).items()
    ).encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in {**files, "SHA256SUMS": sums}.items():
            archive.writestr(name, data)
    return buffer.getvalue(), hashlib.sha256(sums).hexdigest()


GOOD = {"install.py": b"import json", "a.whl": b"wheel"}


@pytest.mark.parametrize(
    ("files", "complaint"),
    [
        ({**GOOD, "install.py": b"import evil"}, "install.py is not what"),
        ({**GOOD, "more.py": b"evil"}, "other files"),
        ({**GOOD, "../../etc/cron.d/x": b"evil"}, "other files"),
        ({"install.py": b"import json"}, "other files"),
    ],
)
def test_a_package_that_differs_from_its_list_is_refused(files: dict[str, bytes], complaint: str) -> None:
    data, digest = packed(files, GOOD)

    with pytest.raises(SystemExit, match=complaint):
        verified(data, digest)


def test_a_package_with_another_list_than_the_templates_is_refused() -> None:
    evil, _ = packed({**GOOD, "install.py": b"import evil"})
    _, digest = packed(GOOD)

    with pytest.raises(SystemExit, match="not the one that the template names"):
        verified(evil, digest)


def unit(repository: Path, name: str) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(interpolation=None, strict=True)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(repository / "stacks" / "boot" / name)
    return parser


@pytest.mark.parametrize(
    "name",
    ["rse-pf.service", "rse-pf-agent.service", "rse-pf-data.service", "rse-pf-rosbridge.service"],
)
def test_every_service_has_its_own_user_and_walls_and_comes_back(repository: Path, name: str) -> None:
    service = unit(repository, name)["Service"]

    assert service["User"] == "rse-pf"
    assert service["Restart"] in ("on-failure", "always")
    assert service["NoNewPrivileges"] == "yes"
    assert service["ProtectSystem"] == "strict"
    assert service["CapabilityBoundingSet"] == ""
    assert service["StateDirectory"] == "rse-pf"
    assert unit(repository, name)["Unit"]["StartLimitIntervalSec"] == "0", "a unit that gives up stays down"


@pytest.mark.parametrize("name", ["rse-pf.service", "rse-pf-data.service"])
def test_the_server_and_the_data_service_share_a_store_and_keep_an_audit_log(
    repository: Path, name: str
) -> None:
    started = unit(repository, name)["Service"]["ExecStart"]

    assert " --store ${STORE} " in f"{started} "
    assert " --audit /var/lib/rse-pf/audit" in started


def test_keys_and_deny_list_lie_in_memory_which_no_full_disk_and_no_earlier_boot_can_change(
    repository: Path,
) -> None:
    agent, server, data = (
        unit(repository, f"{name}.service")["Service"] for name in ("rse-pf-agent", "rse-pf", "rse-pf-data")
    )

    assert all(
        "--keys-file /run/rse-pf/keys.json" in line for line in (agent["ExecStart"], server["ExecStartPre"])
    )
    assert all("--keys /run/rse-pf/keys.json" in each["ExecStart"] for each in (server, data))
    for writer in (agent, server):
        assert (writer["RuntimeDirectory"], writer["RuntimeDirectoryPreserve"]) == ("rse-pf", "yes")


def test_the_agent_makes_and_carries_the_token_that_the_server_asks_for(repository: Path) -> None:
    server, agent = (unit(repository, name)["Service"] for name in ("rse-pf.service", "rse-pf-agent.service"))
    wanted = " --control-token /var/lib/rse-pf/control.token"

    assert all(wanted in line for line in (server["ExecStart"], server["ExecStartPre"], agent["ExecStart"]))
    assert server["ExecStartPre"].endswith(" --once"), "that is what makes it"
    assert server["User"] == agent["User"]


def test_an_unknown_region_says_how_to_look_its_prefix_list_up() -> None:
    if shutil.which("node") is None:
        pytest.skip("the CDK needs Node.js")
    pytest.importorskip("aws_cdk", reason="run make setup")
    from rse_pf.errors import ConfigurationError
    from stacks.firewall import s3_prefix_list

    with pytest.raises(ConfigurationError) as told:
        s3_prefix_list(PlatformSettings.from_dict({"cloud": {"region": "mars-north-1"}}))

    assert "cloud.s3_prefix_list" in told.value.hint
    assert "com.amazonaws.mars-north-1.s3" in told.value.hint
    known = PlatformSettings.from_dict({"cloud": {"region": "mars-north-1", "s3_prefix_list": "pl-1"}})
    assert s3_prefix_list(known) == "pl-1"


def test_a_package_without_a_list_is_refused() -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("install.py", b"x")

    with pytest.raises(SystemExit, match="not the one"):
        verified(buffer.getvalue(), "0" * 64)


def test_the_environment_file_holds_plain_words_only() -> None:
    assert environment_file(FACTS).splitlines() == [
        "SERVER_ID=i-0abc", "BUCKET=artifacts", "KEYS_NAME=keys.json", "GROUP=rse-pf", "HOOK=drain",
        "LAUNCH_HOOK=launch",
        "STORE=s3:maps", "AUDIT_BUCKET=audit-logs",
    ]  # fmt: skip
    for bad in ("", "a\nUser=root", "a b", '"', "$HOME"):
        with pytest.raises(SystemExit, match="not a plain word"):
            environment_file({**FACTS, "server": bad})
