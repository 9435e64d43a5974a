"""A bare Debian machine in a network of its own, with IMDS and S3 in reach and nothing else.

Needs root, `ip`, `openssl` and `debootstrap` (once: the root is kept in build/).  The default route leads to
a device that counts and drops, so an attempt to reach the internet is seen.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
FIRST_BOOT = HERE.parents[2] / "stacks/boot/first_boot.py"
REGION = "ap-northeast-2"
AWS = "127.0.0.2"
NAMES = [
    f"{name}.{REGION}.amazonaws.com"
    for name in ("assets.s3", "artifacts.s3", "audit.s3", "maps.s3", "s3", "monitoring")
]
SCALING, SCALING_NAME = "127.0.0.3", f"autoscaling.{REGION}.amazonaws.com"
"""Of a small server of ours: the emulator has no CompleteLifecycleAction."""
PACKAGES = "python3,ca-certificates,systemd"
TOOLS = ("ip", "unshare", "openssl", "chroot", "cp")


def missing() -> str:
    """Return why no machine can be made here, or nothing."""
    if os.geteuid():
        return "needs root: a root file system and a network namespace are made"
    lacking = [tool for tool in TOOLS if not shutil.which(tool)]
    return f"needs {', '.join(lacking)}" if lacking else ""


def debian_root(kept: Path) -> Path:
    """Return a bare Debian 12, made once; raises FileNotFoundError without debootstrap."""
    if not (kept / "made").is_file():
        shutil.rmtree(kept, ignore_errors=True)
        kept.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(
            ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", "bookworm", str(kept)],
            check=True, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        (kept / "made").touch()
    return kept


class World:
    """One machine; leave the context and nothing of it is left."""

    def __init__(self, folder: Path, kept_root: Path) -> None:
        self.folder = folder
        self.root = folder / "root"
        self.space = f"rse-pf-boot-{os.getpid()}"
        self.ca = folder / "ca.pem"
        self.lifecycle = folder / "lifecycle"
        self.role = folder / "role"
        self.hooks = folder / "hooks"
        self.log: list[str] = []
        self._heard = threading.Condition()
        self._kept_root = kept_root
        self._ends = contextlib.ExitStack()

    def __enter__(self) -> World:
        with contextlib.ExitStack() as ends:
            self._make_network(ends)
            self._make_root()
            self.lifecycle.write_text("InService")
            self.role.write_text("server-role")
            self.hooks.write_text("")
            self._serve(ends, [sys.executable, str(HERE / "imds.py"), str(self.lifecycle), str(self.role)])
            scaling = [str(HERE / "scaling.py"), SCALING, str(self.ca), str(self.folder / "ca.key")]
            self._serve(ends, [sys.executable, *scaling, str(self.hooks)])
            moto = [str(Path(sys.executable).with_name("moto_server")), "-H", AWS, "-p", "443"]
            self._serve(ends, [*moto, "-s", "-c", str(self.ca), "-k", str(self.folder / "ca.key")])
            places = (("169.254.169.254", 80), (AWS, 443), (SCALING, 443))
            self.wait(lambda: all(self._opens(*each) for each in places), 120, "IMDS and AWS")
            self._ends = ends.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ends.close()

    def boot(self, package: Path, digest: str, *, script: Path = FIRST_BOOT, **changes: str) -> None:
        """Put the package into S3 and switch the machine on; *changes* are facts that its user data tells."""
        archive = self.folder / "package.zip"
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as made:  # as the CDK does
            for file in sorted(package.rglob("*")):
                if file.is_file():
                    made.write(file, file.relative_to(package).as_posix())
        self.inside("fill", str(archive))
        facts = {
            "package": "s3://assets/package.zip", "sha256": digest, "region": REGION,
            "domain": "amazonaws.com", "bucket": "artifacts",
            "keys": "keys.json", "group": "rse-pf", "hook": "rse-pf-drain", "store": "s3:maps",
            "launch": "rse-pf-launch", "retry_s": "120", "audit": "audit", **changes,
        }  # fmt: skip
        text = script.read_text(encoding="utf-8")
        (self.root / "boot-test/user-data").write_text(f"{text}\nmain({json.dumps(facts)})\n")
        machine = [
            "unshare", "--mount", "--pid", "--fork", "--kill-child", f"--mount-proc={self.root}/proc",
            "chroot", str(self.root), "/usr/bin/python3", "/boot-test/machine.py",
        ]  # fmt: skip
        listener = threading.Thread(target=self._listen, daemon=True)
        self._ends.callback(listener.join, 10)
        self._packets_before = self._packets()  # moto and the metadata server look their own names up
        self._console = self._serve(
            self._ends, machine, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        listener.start()

    def completed(self) -> list[tuple[str, str]]:
        """Return each lifecycle action that was completed: its hook and its result."""
        return [tuple(line.split()) for line in self.hooks.read_text().splitlines()]

    def console(self) -> str:
        """Return what was written to the machine's console."""
        return (self.root / "dev/console").read_text()

    def inside(self, *arguments: str) -> Any:
        """Run inside.py in the machine's network; return what it printed, as JSON."""
        told = self.run([sys.executable, str(HERE / "inside.py"), str(self.ca), *arguments])
        return json.loads(told) if told.strip() else None

    def run(self, command: list[str]) -> str:
        """Run *command* in the machine's network and return its output."""
        environment = {**os.environ, "PYTHONPATH": str(HERE.parents[2])}
        done = subprocess.run(
            ["ip", "netns", "exec", self.space, *command], capture_output=True, text=True, env=environment,
            timeout=120, check=False,
        )  # fmt: skip
        assert not done.returncode, f"{command}: {done.stderr}\n{self.text()}"
        return done.stdout

    def status(self, port: int, path: str) -> int:
        """Return the HTTP status that the machine's port answers, 0 when nobody listens."""
        ask = (
            "import sys,http.client as h\ntry:\n c=h.HTTPConnection('127.0.0.1',int(sys.argv[1]),timeout=2)\n"
            " c.request('GET',sys.argv[2]); print(c.getresponse().status)\nexcept OSError: print(0)"
        )
        return int(self.run([sys.executable, "-c", ask, str(port), path]))

    def packets_to_the_outside(self) -> int:
        """Return how many packets took the default route since the machine was switched on."""
        return self._packets() - self._packets_before

    def wait(self, happened: Any, within_s: float, what: str) -> None:
        """Wait until *happened()*, or fail with the machine's console."""
        until = time.monotonic() + within_s
        with self._heard:
            while not happened():
                assert time.monotonic() < until, f"no {what} within {within_s} s:\n{self.text()}"
                self._heard.wait(0.2)

    def text(self) -> str:
        """Return the console."""
        return "".join(self.log)

    def _packets(self) -> int:
        return int(self.run(["cat", "/sys/class/net/out0/statistics/tx_packets"]))

    def _listen(self) -> None:
        with self._console.stdout as console:
            for line in console:
                with self._heard:
                    self.log.append(line)
                    self._heard.notify_all()

    def _serve(self, ends: contextlib.ExitStack, command: list[str], **options: Any) -> subprocess.Popen[Any]:
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(["ip", "netns", "exec", self.space, *command], **{**silent, **options})
        ends.callback(process.wait, 20)
        ends.callback(process.kill)
        return process

    def _opens(self, host: str, port: int) -> bool:
        script = (
            f"import socket\ntry: socket.create_connection(({host!r}, {port}), 1); print(1)\n"
            "except OSError: print(0)"
        )
        return self.run([sys.executable, "-c", script]).strip() == "1"

    def _make_network(self, ends: contextlib.ExitStack) -> None:
        subprocess.run(["ip", "netns", "add", self.space], check=True)
        ends.callback(subprocess.run, ["ip", "netns", "delete", self.space], check=False)
        for line in (
            "link set lo up", "address add 169.254.169.254/32 dev lo",
            "link add out0 type veth peer name out1", "address add 192.0.2.2/24 dev out0",
        ):  # fmt: skip
            self.run(["ip", *line.split()])
        for device in ("out0", "out1"):
            self.run(["sh", "-c", f"echo 1 > /proc/sys/net/ipv6/conf/{device}/disable_ipv6"])
            self.run(["ip", "link", "set", device, "up"])
        self.run(["ip", "neighbour", "add", "192.0.2.1", "lladdr", "02:00:00:00:00:01", "dev", "out0"])
        self.run(["ip", "route", "add", "default", "via", "192.0.2.1"])

    def _make_root(self) -> None:
        subprocess.run(["cp", "-a", "--reflink=auto", f"{self._kept_root}/.", str(self.root)], check=True)
        names = ",".join(f"DNS:{name}" for name in (*NAMES, SCALING_NAME)) + f",IP:{AWS}"
        subprocess.run(
            ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=aws",
             "-addext", f"subjectAltName={names}", "-keyout", str(self.folder / "ca.key"),
             "-out", str(self.ca)],
            check=True, capture_output=True,
        )  # fmt: skip
        with (self.root / "etc/ssl/certs/ca-certificates.crt").open("a") as trusted:
            trusted.write(self.ca.read_text())
        hosts = f"127.0.0.1 localhost\n{AWS} {' '.join(NAMES)}\n{SCALING} {SCALING_NAME}\n"
        (self.root / "etc/hosts").write_text(hosts)
        (self.root / "etc/resolv.conf").write_text("nameserver 192.0.2.53\n")
        console = self.root / "dev/console"
        console.unlink(missing_ok=True)
        console.write_text("")  # a file instead of the device: it is read
        (self.root / "boot-test").mkdir()
        shutil.copyfile(HERE / "machine.py", self.root / "boot-test/machine.py")
        systemctl = self.root / "usr/bin/systemctl"
        systemctl.unlink(missing_ok=True)
        systemctl.write_text('#!/bin/sh\necho "$@" >> /run/orders\n')
        systemctl.chmod(0o755)
