#!/usr/bin/python3
"""Fetch a backend server's package, verify it, and run its install.py; cloud-init runs this once, as root.

Uses the standard library only: credentials come from IMDSv2, and requests are signed with SigV4.  It connects
to IMDS, S3 and Auto Scaling only, and writes or runs only files whose digests match the template's.  A failed
boot writes its last lines to the console and abandons the launch, so that the group replaces the machine.
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

IMDS = "http://169.254.169.254/latest/"  # instance metadata service
PACKAGE = pathlib.Path("/opt/rse-pf/package")  # folder into which the package is unpacked
SUMS = "SHA256SUMS"  # file in the package with the digests of all other files
PAUSE_S = 5.0  # seconds between two attempts to fetch the package
CONSOLE = pathlib.Path("/dev/console")
LAST_LINES = collections.deque(maxlen=20)  # the log lines that are written to the console after a failure


def signed_headers(host, target, region, credentials, now, service="s3"):
    """Return the headers of a GET request to an AWS service, signed with Signature Version 4.

    *target* is the path of the request, with its query if it has one; *now* is UTC.
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
    """Return the zip archive *data* after its files were verified; else raise SystemExit.

    *sha256* is the digest of the file `SUMS` in the archive, which has the digest of each other file.
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
    """Fetch, verify and install the package; *facts* come from `stacks.backend_servers`.

    After a failure write the last lines to the console, abandon the launch and exit with 1: the group
    replaces the machine.
    """
    try:
        install(facts)
    except BaseException as error:
        say(f"first boot: failed: {type(error).__name__}: {error}")
        write_console()
        abandon(facts)
        raise SystemExit(1) from error


def install(facts):
    """Fetch and verify the package, unpack it, and run its install.py; raise SystemExit if that fails."""
    data, server = retry_for(lambda: fetched(facts), float(facts["retry_s"]))
    PACKAGE.mkdir(parents=True, exist_ok=True)
    verified(data, facts["sha256"]).extractall(PACKAGE)
    facts_text = json.dumps({**facts, "server": server})
    command = [sys.executable, str(PACKAGE / "install.py"), facts_text]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
        for line in running.stdout:
            say(line.rstrip())
    if running.returncode:
        raise SystemExit(f"install.py exited with {running.returncode}")


def fetched(facts):
    """Return the package's bytes and the id of this instance."""
    token = imds("api/token")
    bucket, _, name = facts["package"].split("://", 1)[1].partition("/")
    host = f"{bucket}.s3.{facts['region']}.{facts['domain']}"
    return asked(host, "/" + urllib.parse.quote(name), facts, token), imds("meta-data/instance-id", token)


def abandon(facts):
    """Complete the launch hook with ABANDON, so that the group replaces this machine at once.

    If the call fails, the hook's own timeout has the same effect.
    """
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
    """Return the body of the answer to a GET request, signed with the credentials of the instance's role."""
    role = imds("meta-data/iam/security-credentials/", token).split()[0]
    credentials = json.loads(imds("meta-data/iam/security-credentials/" + role, token))
    now = datetime.datetime.now(datetime.timezone.utc)
    headers = signed_headers(host, target, facts["region"], credentials, now, service)
    request = urllib.request.Request(f"https://{host}{target}", headers=headers)
    with urllib.request.urlopen(request, timeout=60) as answer:
        return answer.read()


def imds(path, token=None):
    """Return the text of the instance metadata at *path*; without *token*, request a new session token."""
    request = urllib.request.Request(IMDS + path, method="GET" if token else "PUT")
    if token:
        request.add_header("X-aws-ec2-metadata-token", token)
    else:
        request.add_header("X-aws-ec2-metadata-token-ttl-seconds", "300")
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.read().decode()


def retry_for(call, within_s):
    """Return the result of *call*; repeat it after an error, for at most *within_s* seconds.

    The role and the endpoints may become available a little later than the machine.
    """
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
    """Write *line* to cloud-init's log, and keep it for `write_console`."""
    sys.stderr.write(line + "\n")
    LAST_LINES.append(line)


def write_console():
    """Write the last lines to the console; AWS keeps it after the machine (aws ec2 get-console-output)."""
    with contextlib.suppress(OSError):
        CONSOLE.write_text("".join(f"rse-pf: {line}\r\n" for line in LAST_LINES), encoding="utf-8")
