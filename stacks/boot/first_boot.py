#!/usr/bin/python3
"""Fetch a backend server's package, verify it, let it install itself; cloud-init runs this once, as root.

Standard library alone: credentials from IMDSv2, one GET signed with SigV4.  Promises no address but IMDS and
S3, and that not one byte is written or run that the template's digest does not vouch for.
"""

import datetime
import hashlib
import hmac
import io
import json
import pathlib
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
import zipfile

__all__ = ["main", "signed_headers", "verified"]

IMDS = "http://169.254.169.254/latest/"
PACKAGE = pathlib.Path("/opt/rse-pf/package")
SUMS = "SHA256SUMS"
TRIES, PAUSE_S = 30, 5.0


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


def verified(data, sha256):
    """Return the zip archive *data* once every file in it is vouched for.

    *sha256* is the digest of its list of sums, which names each other file exactly once.
    """
    archive = zipfile.ZipFile(io.BytesIO(data))
    sums = archive.read(SUMS) if SUMS in archive.namelist() else b""
    if hashlib.sha256(sums).hexdigest() != sha256:
        raise SystemExit("first boot: the package is not the one that the template names")
    wanted = dict(reversed(line.split("  ", 1)) for line in sums.decode().splitlines())
    files = [name for name in archive.namelist() if not name.endswith("/") and name != SUMS]
    if sorted(files) != sorted(wanted):
        raise SystemExit("first boot: the package holds other files than its list")
    for name in files:
        if hashlib.sha256(archive.read(name)).hexdigest() != wanted[name]:
            raise SystemExit(f"first boot: {name} is not what the package's list says")
    return archive


def main(facts):
    """Fetch, verify, install; any failure ends the boot, and the group replaces the machine."""
    data, server = patiently(lambda: fetched(facts))
    PACKAGE.mkdir(parents=True, exist_ok=True)
    verified(data, facts["sha256"]).extractall(PACKAGE)
    told = json.dumps({**facts, "server": server})
    subprocess.run([sys.executable, str(PACKAGE / "install.py"), told], check=True)


def fetched(facts):
    """Return the package's bytes and the name of this instance."""
    token = imds("api/token")
    role = imds("meta-data/iam/security-credentials/", token).split()[0]
    credentials = json.loads(imds("meta-data/iam/security-credentials/" + role, token))
    bucket, _, name = facts["package"].split("://", 1)[1].partition("/")
    host = f"{bucket}.s3.{facts['region']}.amazonaws.com"
    path = "/" + urllib.parse.quote(name)
    now = datetime.datetime.now(datetime.timezone.utc)
    headers = signed_headers(host, path, facts["region"], credentials, now)
    request = urllib.request.Request(f"https://{host}{path}", headers=headers)
    with urllib.request.urlopen(request, timeout=60) as answer:
        return answer.read(), imds("meta-data/instance-id", token)


def imds(path, token=None):
    """Return a fact of this instance, or a session token when there is none yet."""
    request = urllib.request.Request(IMDS + path, method="GET" if token else "PUT")
    if token:
        request.add_header("X-aws-ec2-metadata-token", token)
    else:
        request.add_header("X-aws-ec2-metadata-token-ttl-seconds", "300")
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.read().decode()


def patiently(call):
    """Return what *call* returns; roles and endpoints may come a little later than the machine."""
    for left in range(TRIES - 1, -1, -1):
        try:
            return call()
        except OSError as error:
            sys.stderr.write(f"first boot: {error}\n")
            if not left:
                raise
            time.sleep(PAUSE_S)
    return None
