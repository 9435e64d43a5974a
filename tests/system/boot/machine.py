"""Process 1 of the machine under test: runs the user data, then starts units as systemd would.

Runs inside the Debian root, with its Python and standard library alone.  Of a unit it knows what ours use:
User, EnvironmentFile, StateDirectory, RuntimeDirectory, ExecStartPre, ExecStart, Restart and RestartSec.  The
`systemctl` in the root only writes its arguments to ORDERS.
"""

import os
import pathlib
import pwd
import re
import resource
import shlex
import signal
import subprocess
import sys
import time

ORDERS = pathlib.Path("/run/orders")
UNITS = pathlib.Path("/etc/systemd/system")
CA = "/etc/ssl/certs/ca-certificates.crt"
LOOK_S = 0.2


def say(*words):
    print("machine:", *words, flush=True)


def entries(name):
    """Return a unit's settings; the last of a repeated one counts."""
    lines = (UNITS / name).read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if "=" in line and not line.startswith("#"))


class Service:
    """One running service unit."""

    def __init__(self, name):
        self.name, self.unit, self.process, self.again_at = name, entries(name), None, 0.0
        self.wanted = True
        user = pwd.getpwnam(self.unit["User"])
        for parent, setting in (("/var/lib", "StateDirectory"), ("/run", "RuntimeDirectory")):
            if setting in self.unit:
                folder = pathlib.Path(parent, self.unit[setting])
                folder.mkdir(exist_ok=True)
                os.chown(folder, user.pw_uid, user.pw_gid)
        text = pathlib.Path(self.unit["EnvironmentFile"]).read_text()
        self.environment = dict(line.split("=", 1) for line in text.splitlines())
        self.options = {
            "user": user.pw_uid,
            "group": user.pw_gid,
            "extra_groups": [],
            "cwd": "/",
            "env": {"PATH": "/usr/bin:/bin", "AWS_CA_BUNDLE": CA, **self.environment},
        }

    def words(self, command):
        return [
            re.sub(r"\$\{(\w+)\}", lambda found: self.environment[found[1]], word)
            for word in shlex.split(command)
        ]

    def start(self):
        before = self.unit.get("ExecStartPre")
        if before and subprocess.run(self.words(before), **self.options).returncode:
            say(self.name, "ExecStartPre failed")
            self.again_at = time.monotonic() + float(self.unit["RestartSec"])
            return
        self.process = subprocess.Popen(self.words(self.unit["ExecStart"]), **self.options)
        say("started", self.name)

    def stop(self):
        if self.process and self.process.poll() is None:
            self.process.terminate()
            self.process.wait(float(self.unit["TimeoutStopSec"]))

    def look(self):
        if not self.wanted:
            return
        if self.process is None:
            if time.monotonic() >= self.again_at:
                self.start()
        elif self.process.poll() is not None:
            code, self.process = self.process.returncode, None
            say(self.name, "ended with", code)
            self.wanted = bool(code) or self.unit["Restart"] == "always"
            self.again_at = time.monotonic() + float(self.unit["RestartSec"])


def main():
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    ORDERS.write_text("")
    began = time.monotonic()
    code = subprocess.run(["/usr/bin/python3", "/boot-test/user-data"]).returncode
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = f"after {time.monotonic() - began:.1f} s, {used.ru_utime + used.ru_stime:.1f} s of CPU"
    say("user-data ended with", code, spent)
    services, done = {}, 0
    while True:
        orders = ORDERS.read_text().splitlines()
        for order in orders[done:]:
            say("systemctl", order)
            verb, *names = [word for word in order.split() if not word.startswith("--")]
            for name in names:
                if verb == "enable" and name.endswith(".service"):
                    services[name] = Service(name)
        done = len(orders)
        for service in services.values():
            service.look()
        time.sleep(LOOK_S)


main()
