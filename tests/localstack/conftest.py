"""LocalStack, which `make localstack` starts, and the stacks as the CDK deploys them there."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from tests.kit.emulated_aws import REGION, is_localstack, load_services, localstack_url

ACCOUNT = "000000000000"
DEPLOYED = ("Network", "Data", "Backend")
"""Boxes that the community edition deploys; `test_deployment` says why the others fail."""
SETTINGS = PlatformSettings().replace(
    cloud={"image_parameter": "/debian/image"},
    scaling={"profile": "fast", "max_robots_per_server": 50, "warm_up_s": 0},
)
"""All alarms; LocalStack lets nobody write parameters below /aws, where Debian's are."""
_MINUTES = 5 * 60.0


@dataclass(frozen=True)
class Deployment:
    """The synthesised stacks, and what the CDK's command line said of them."""

    folder: Path
    repository: Path

    def template(self, box: str) -> dict[str, Any]:
        """Return the template of one stack."""
        text = (self.folder / f"RsePf-{box}.template.json").read_text(encoding="utf-8")
        return dict(json.loads(text))

    def cdk(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run the CDK's command line on the synthesised stacks."""
        return subprocess.run(
            ["sh", "scripts/cdk.sh", "--ci", "--app", str(self.folder), *words],
            cwd=self.repository, env={**os.environ, **environment()}, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=_MINUTES, check=False,
        )  # fmt: skip


def environment() -> dict[str, str]:
    """Return the variables by which boto3 and the CDK find LocalStack."""
    return {
        "AWS_ENDPOINT_URL": localstack_url(), "AWS_ENDPOINT_URL_S3": localstack_url(),
        "AWS_ACCESS_KEY_ID": ACCOUNT, "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_REGION": REGION, "AWS_DEFAULT_REGION": REGION, "AWS_EC2_METADATA_DISABLED": "true",
    }  # fmt: skip


@pytest.fixture(scope="session", autouse=True)
def in_localstack() -> Any:
    """The account of the deployment; without LocalStack, the tests are skipped."""
    if not is_localstack():
        pytest.skip("LOCALSTACK_HOST is not set: make localstack sets it")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment().items():
            patch.setenv(name, value)
        load_services()
        yield


@pytest.fixture(scope="session")
def deployment(in_localstack: None, tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Deployment:
    """An account that is bootstrapped, with the stacks that can be deployed there."""
    from rse_pf.aws.clients import make_client

    made = Deployment(_synthesise(tmp_path_factory.mktemp("synthesis"), repository), repository)
    make_client("ssm", REGION).put_parameter(
        Name=SETTINGS.cloud.image_parameter, Value="ami-0123456789abcdef0", Type="String"
    )
    for words in (
        ("bootstrap", f"aws://{ACCOUNT}/{REGION}"),
        ("deploy", "--require-approval", "never", *(f"RsePf-{box}" for box in DEPLOYED)),
    ):
        done = made.cdk(*words)
        assert done.returncode == 0, done.stdout[-3000:]
    return made


def _synthesise(folder: Path, repository: Path) -> Path:
    cdk = pytest.importorskip("aws_cdk", reason="run make setup")
    from app import build
    from stacks.assets import SERVERS

    for name in (SERVERS, "lambda"):
        (folder / name).mkdir()
        (folder / name / "package.txt").write_text(name, encoding="utf-8")
    context = json.loads((repository / "cdk.json").read_text(encoding="utf-8"))["context"]
    app = cdk.App(outdir=str(folder / "out"), context={k: v for k, v in context.items() if k != "rse-pf"})
    build(app, SETTINGS, folder)
    app.synth()
    return folder / "out"
