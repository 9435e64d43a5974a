"""Add third-party code inside the package to bills of materials in CycloneDX: python scripts/sbom.py FILE ...

The bills list the packages of the locks already.  The fleet page contains third-party JavaScript, and
``rse_pf/extensions/fleet_page/static/vendor/vendored.json`` lists its files with versions, licences and
digests.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rse_pf.extensions.fleet_page.static_files import vendored

__all__ = ["main", "with_vendored"]

# Folder of the third-party files in the fleet page.
_FOLDER = "rse_pf/extensions/fleet_page/static/vendor"


def with_vendored(bill: Mapping[str, Any], packages: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return *bill* with a component for each of *packages*, and in it one for each of its files.

    Components of an earlier run are replaced.
    """
    added = [_component(package) for package in packages]
    names = {component["bom-ref"] for component in added}
    root = bill["metadata"]["component"]["bom-ref"]
    components = [component for component in bill.get("components", ()) if component["bom-ref"] not in names]
    depends = {dependency["ref"]: dict(dependency) for dependency in bill.get("dependencies", ())}
    depends.update((name, {"ref": name}) for name in names)
    of_root = depends.setdefault(root, {"ref": root})
    of_root["dependsOn"] = sorted({*of_root.get("dependsOn", ()), *names})
    return {
        **bill,
        "components": sorted([*components, *added], key=lambda each: str(each["bom-ref"])),
        "dependencies": [depends[name] for name in sorted(depends)],
    }


def main(files: Sequence[str]) -> int:
    """Add the components to each of the bills *files*; return the exit code."""
    for file in map(Path, files):
        bill = with_vendored(json.loads(file.read_text("utf-8")), vendored())
        file.write_text(json.dumps(bill, indent=2) + "\n", encoding="utf-8")
    return 0


def _component(package: Mapping[str, Any]) -> dict[str, Any]:
    address = f"pkg:npm/{package['name']}@{package['version']}"
    return {
        "bom-ref": address,
        "type": "library",
        "name": package["name"],
        "version": package["version"],
        "description": f"in the fleet page, {package['use']}",
        "licenses": [{"license": {"id": package["licence"], "acknowledgement": "declared"}}],
        "purl": address,
        "externalReferences": [{"type": "distribution", "url": package["source"]}],
        "components": [
            {
                "bom-ref": f"{address}#{name}",
                "type": "file",
                "name": f"{_FOLDER}/{name}",
                "hashes": [{"alg": "SHA-256", "content": digest}],
            }
            for name, digest in sorted(package["files"].items())
        ],
    }


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
