"""Write the table of docs/clients.md from out/clients.json, which `make clients` wrote."""

from __future__ import annotations

import json
import statistics
import sys
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
PAGE, RESULT = REPOSITORY / "docs" / "clients.md", REPOSITORY / "out" / "clients.json"
BEGIN, END = "<!-- table of clients -->\n", "<!-- end of the table -->\n"
FEATURES = {
    "golden": "reads every golden message",
    "pnp": "poses of the golden commands, within 1e-6",
    "typed-error": "typed errors with hints",
    "undecodable": "the server's reason for commands that it cannot decode, within 1 s",
    "busy": "offers four times its limits: paced, nothing lost",
    "deadline": "deadlines while the servers are stalled",
    "newest": "the newest command of a stream wins",
    "stream/kill": "its server is killed: 0 lost, 0 twice",
    "stream/drain": "its server is drained: moves, 0 lost",
    "stream/move": "is asked to move: 0 lost",
    "stream/wifi": "no network for 5 s: 0 lost, 0 twice",
    "stream/fragments": "messages in fragments of 4 KiB",
    "stream/slow": "reads 2 kB a second for 4 s: 0 lost",
    "renew": "renews its token, on one connection",
    "expired": "typed end when its token expires",
    "revoked": "typed end when it is revoked, and stays away",
    "returns/cut-off": "back within 5 s when its tokens until now are revoked",
    "returns/disabled": "told that it is disabled, back by itself when it is enabled",
    "returns/clock-ahead": "told that its clock is 120 s ahead, back within 5 s when it is set",
    "returns/clock-behind": "told of a cut-off that its clock is behind of, back within 5 s when it is set",
    "returns/away": "back by itself when its platform is",
    "updates": "subscribes to a live map",
    "progress": "progress and cancel of a long command",
    "data": "large data, up and down",
}


def table(document: dict[str, Any]) -> str:
    """Return the table of *document*: a line for each feature, a column for each client."""
    rows = [row for row in document["rows"] if row["client"] != "platform"]
    clients = list(dict.fromkeys(row["client"] for row in rows))
    lines = [
        f"Version {document['version']}, {document['date']}; runs of each scenario: {document['runs']}; "
        f"load average of the machine at the end: {document['load_average']}.",
        "",
        f"| | {' | '.join(clients)} |",
        f"|---|{'---|' * len(clients)}",
    ]
    for scenario, feature in FEATURES.items():
        cells = [verdict([r for r in rows if (r["client"], r["scenario"]) == (c, scenario)]) for c in clients]
        lines.append(f"| {feature} | {' | '.join(cells)} |")
    times = [round_trip([r for r in rows if r["client"] == client]) for client in clients]
    lines.append(f"| round trip of a pose, median, ms | {' | '.join(times)} |")
    return "\n".join([*lines, ""])


def verdict(rows: list[dict[str, Any]]) -> str:
    """Return what a cell says: whether all runs passed, or that there is no such feature, or no client."""
    if any(row["passed"] is False for row in rows):
        return "**failed**"
    if any(row["passed"] for row in rows):
        return "yes"
    return "no" if any(row["skipped"] == "not claimed" for row in rows) else "not run"


def round_trip(rows: list[dict[str, Any]]) -> str:
    """Return the median time of the streams in which nothing failed."""
    times = [row["figures"]["p50_ms"] for row in rows if row["scenario"] == "stream/move" and row["passed"]]
    return f"{statistics.median(times):.1f}" if times else ""


def with_table(page: str, text: str) -> str:
    """Return *page* with *text* between its marks."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{text}\n{END}{after}"


def main() -> int:
    """Rewrite the page; return 1 without a result."""
    if not RESULT.exists():
        print(f"{RESULT.relative_to(REPOSITORY)} is missing: make clients writes it", file=sys.stderr)
        return 1
    document = json.loads(RESULT.read_text(encoding="utf-8"))
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), table(document)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
