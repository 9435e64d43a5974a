#!/usr/bin/python3
"""Turn a bare Debian 12 machine into a backend server; cloud-init runs this once, as root.

Fetches the package from S3 with the machine's own credentials (IMDSv2, SigV4; standard library alone),
installs its wheels without any index, and starts the unit.  Promises no address but IMDS and S3.
"""

import datetime
import hashlib
import hmac
import io
import json
import os
import pathlib
import subprocess
import urllib.parse
import urllib.request
import zipfile

__all__ = ["main", "signed_headers"]

IMDS = "http://169.254.169.254/latest/"
HOME = pathlib.Path("/opt/rse-pf")
UNIT = """[Unit]
Description=RSE-PF backend server
After=network-online.target
[Service]
User=rse-pf
Environment=PYTHONPATH=/opt/rse-pf/lib
ExecStart=/usr/bin/python3 -m rse_pf.cli.main serve --settings /opt/rse-pf/package/settings.json \\
  --host 0.0.0.0 --control-host 0.0.0.0 --keys /opt/rse-pf/keys.json --server-id {server}
Restart=always
RestartSec=2
TimeoutStopSec=60
LimitNOFILE=65536
NoNewPrivileges=yes
ProtectSystem=strict
PrivateTmp=yes
[Install]
WantedBy=multi-user.target
"""


def signed_headers(host, path, region, credentials, now):
    """Return the headers of a GET that S3 accepts (Signature Version 4)."""
    stamp, day = now.strftime("%Y%m%dT%H%M%SZ"), now.strftime("%Y%m%d")
    headers = {"host": host, "x-amz-content-sha256": hashlib.sha256(b"").hexdigest(), "x-amz-date": stamp}
    if credentials.get("Token"):
        headers["x-amz-security-token"] = credentials["Token"]
    names = ";".join(sorted(headers))
    lines = "".join(f"{name}:{headers[name]}\n" for name in sorted(headers))
    request = "\n".join(["GET", path, "", lines, names, headers["x-amz-content-sha256"]])
    scope = f"{day}/{region}/s3/aws4_request"
    text = "\n".join(["AWS4-HMAC-SHA256", stamp, scope, hashlib.sha256(request.encode()).hexdigest()])
    key = ("AWS4" + credentials["SecretAccessKey"]).encode()
    for part in (day, region, "s3", "aws4_request"):
        key = hmac.new(key, part.encode(), hashlib.sha256).digest()
    signature = hmac.new(key, text.encode(), hashlib.sha256).hexdigest()
    headers["authorization"] = (
        f"AWS4-HMAC-SHA256 Credential={credentials['AccessKeyId']}/{scope}, "
        f"SignedHeaders={names}, Signature={signature}"
    )
    return headers


def _imds(path, token=None):
    if token is None:
        request = urllib.request.Request(IMDS + path, method="PUT")
        request.add_header("X-aws-ec2-metadata-token-ttl-seconds", "300")
    else:
        request = urllib.request.Request(IMDS + path, headers={"X-aws-ec2-metadata-token": token})
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.read().decode()


def _get(url, region, credentials):
    bucket, _, name = url.split("://", 1)[1].partition("/")
    host = f"{bucket}.s3.{region}.amazonaws.com"
    path = "/" + urllib.parse.quote(name)
    now = datetime.datetime.now(datetime.timezone.utc)
    headers = signed_headers(host, path, region, credentials, now)
    request = urllib.request.Request(f"https://{host}{path}", headers=headers)
    with urllib.request.urlopen(request, timeout=60) as answer:
        return answer.read()


def main(facts):
    """Do it all; any failure ends the boot, and the load balancer replaces the machine."""
    token = _imds("api/token")
    role = _imds("meta-data/iam/security-credentials/", token)
    credentials = json.loads(_imds("meta-data/iam/security-credentials/" + role, token))
    HOME.mkdir(parents=True, exist_ok=True)
    package = HOME / "package"
    zipfile.ZipFile(io.BytesIO(_get(facts["package"], facts["region"], credentials))).extractall(package)
    (HOME / "keys.json").write_bytes(_get(facts["keys"], facts["region"], credentials))
    pip = next(package.glob("pip-*.whl"))
    subprocess.run(
        ["/usr/bin/python3", f"{pip}/pip", "install", "--no-index", "--find-links", str(package), "--target",
         str(HOME / "lib"), "rse-pf[backend]"], check=True,
    )  # fmt: skip
    subprocess.run(["/usr/sbin/useradd", "--system", "--no-create-home", "rse-pf"], check=False)
    unit = pathlib.Path("/etc/systemd/system/rse-pf.service")
    unit.write_text(UNIT.replace("{server}", _imds("meta-data/instance-id", token)))
    os.sync()
    subprocess.run(["/usr/bin/systemctl", "enable", "--now", "rse-pf"], check=True)
