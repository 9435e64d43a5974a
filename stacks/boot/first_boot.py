#!/usr/bin/python3
"""Fetch a backend server's package, verify it, let it install itself; cloud-init runs this once, as root.

Standard library alone: credentials from IMDSv2, requests signed with SigV4.  Promises no address but IMDS, S3
and Auto Scaling, and that not one byte is written or run that the template's digest does not vouch for.  A
boot that fails writes its last lines to the console and abandons the launch: the group replaces the machine.
"""

import collections
import contextlib
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

__all__ = ["abandon", "main", "signed_headers", "verified"]

IMDS = "http://169.254.169.254/latest/"
PACKAGE = pathlib.Path("/opt/rse-pf/package")
SUMS = "SHA256SUMS"
PAUSE_S = 5.0
CONSOLE = pathlib.Path("/dev/console")
LINES = collections.deque(maxlen=20)


def signed_headers(host, target, region, credentials, now, service="s3"):
    """Return the headers of a GET that *service* accepts (Signature Version 4).

    *target* is the path of the request, with its query if it has one.
    """
    path, _, query = target.partition("?")
    stamp, day = now.strftime("%Y%m%dT%H%M%SZ"), now.strftime("%Y%m%d")
    headers = {"host": host, "x-amz-content-sha256": hashlib.sha256(b"").hexdigest(), "x-amz-date": stamp}
    if credentials.get("Token"):
        headers["x-amz-security-token"] = credentials["Token"]
    names = ";".join(sorted(headers))
    lines = "".join(f"{name}:{headers[name]}\n" for name in sorted(headers))
    request = "\n".join(["GET", path, query, lines, names, headers["x-amz-content-sha256"]])
    scope = f"{day}/{region}/{service}/aws4_request"
    text = "\n".join(["AWS4-HMAC-SHA256", stamp, scope, hashlib.sha256(request.encode()).hexdigest()])
    key = ("AWS4" + credentials["SecretAccessKey"]).encode()
    for part in (day, region, service, "aws4_request"):
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
    digests = dict(reversed(line.split("  ", 1)) for line in sums.decode().splitlines())
    files = [name for name in archive.namelist() if not name.endswith("/") and name != SUMS]
    if sorted(files) != sorted(digests):
        raise SystemExit("first boot: the package holds other files than its list")
    for name in files:
        if hashlib.sha256(archive.read(name)).hexdigest() != digests[name]:
            raise SystemExit(f"first boot: {name} is not what the package's list says")
    return archive


def main(facts):
    """Fetch, verify, install; report a failure to the console and the group, which replaces the machine."""
    try:
        install(facts)
    except BaseException as error:
        say(f"first boot: failed: {type(error).__name__}: {error}")
        tell_console()
        abandon(facts)
        raise SystemExit(1) from error


def install(facts):
    """Fetch and verify the package, and run its install.py."""
    data, server = retry_for(lambda: fetched(facts), float(facts["retry_s"]))
    PACKAGE.mkdir(parents=True, exist_ok=True)
    verified(data, facts["sha256"]).extractall(PACKAGE)
    facts_text = json.dumps({**facts, "server": server})
    command = [sys.executable, str(PACKAGE / "install.py"), facts_text]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
        for line in running.stdout:
            say(line.rstrip())
    if running.returncode:
        raise SystemExit(f"install.py ended with {running.returncode}")


def fetched(facts):
    """Return the package's bytes and the name of this instance."""
    token = imds("api/token")
    bucket, _, name = facts["package"].split("://", 1)[1].partition("/")
    host = f"{bucket}.s3.{facts['region']}.{facts['domain']}"
    return asked(host, "/" + urllib.parse.quote(name), facts, token), imds("meta-data/instance-id", token)


def abandon(facts):
    """Tell the group that this launch failed; without it the hook's own timeout ends the machine."""
    try:
        token = imds("api/token")
        call = {
            "Action": "CompleteLifecycleAction", "AutoScalingGroupName": facts["group"],
            "InstanceId": imds("meta-data/instance-id", token), "LifecycleActionResult": "ABANDON",
            "LifecycleHookName": facts["launch"], "Version": "2011-01-01",
        }  # fmt: skip
        host = f"autoscaling.{facts['region']}.{facts['domain']}"
        asked(host, "/?" + urllib.parse.urlencode(sorted(call.items())), facts, token, "autoscaling")
    except (OSError, ValueError, IndexError) as error:
        say(f"first boot: not abandoned: {error}")


def asked(host, target, facts, token, service="s3"):
    """Return the answer to a GET, signed as the instance's role."""
    role = imds("meta-data/iam/security-credentials/", token).split()[0]
    credentials = json.loads(imds("meta-data/iam/security-credentials/" + role, token))
    now = datetime.datetime.now(datetime.timezone.utc)
    headers = signed_headers(host, target, facts["region"], credentials, now, service)
    request = urllib.request.Request(f"https://{host}{target}", headers=headers)
    with urllib.request.urlopen(request, timeout=60) as answer:
        return answer.read()


def imds(path, token=None):
    """Return a fact of this instance, or a session token when there is none yet."""
    request = urllib.request.Request(IMDS + path, method="GET" if token else "PUT")
    if token:
        request.add_header("X-aws-ec2-metadata-token", token)
    else:
        request.add_header("X-aws-ec2-metadata-token-ttl-seconds", "300")
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.read().decode()


def retry_for(call, within_s):
    """Return what *call* returns; roles and endpoints may come a little later than the machine."""
    until = time.monotonic() + within_s
    while True:
        try:
            return call()
        except (OSError, IndexError, ValueError) as error:
            say(f"first boot: {error}")
            if time.monotonic() + PAUSE_S >= until:
                raise
            time.sleep(PAUSE_S)


def say(line):
    """Write *line* to cloud-init's log, and keep it."""
    sys.stderr.write(line + "\n")
    LINES.append(line)


def tell_console():
    """Write the last lines to the console, which outlives the machine: aws ec2 get-console-output."""
    with contextlib.suppress(OSError):
        CONSOLE.write_text("".join(f"rse-pf: {line}\r\n" for line in LINES), encoding="utf-8")
