"""The page's files: what others wrote is listed with digests; ours asks nobody outside and runs no text."""

from __future__ import annotations

import hashlib

from rse_pf.extensions.fleet_page.static_files import STATIC, vendored

VENDOR = STATIC / "vendor"


def test_every_vendored_file_is_listed_with_its_digest_version_and_licence() -> None:
    listed = {name: digest for each in vendored() for name, digest in each["files"].items()}
    present = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in VENDOR.iterdir()}
    del present["vendored.json"]

    assert listed == present
    assert {(each["name"], each["version"], each["licence"]) for each in vendored()} == {
        ("three", "0.187.0", "MIT"),
        ("uplot", "1.6.32", "MIT"),
    }
    for each in vendored():
        (licence,) = [name for name in each["files"] if name.endswith(".LICENSE")]
        assert "Permission is hereby granted, free of charge" in (VENDOR / licence).read_text("utf-8")
