"""Write the report of a replay as one HTML file without scripts, fonts or references to other files.

Names and messages from robots and servers are untrusted input: they are escaped, and the content security
policy of the page forbids scripts and requests.
"""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from datetime import datetime, timezone

from rse_pf.extensions.recording.replay.report import Attempt, CommandReport
from rse_pf.extensions.recording.replay.run import Overview
from rse_pf.pnp.rules import Rule
from rse_pf.terminal import counted, printable

__all__ = ["html_page"]

# Content security policy of the page: no scripts, and no requests.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
# Style sheet of the page.
_STYLE = """
:root { color-scheme: light dark;
  --paper: #ffffff; --ink: #1e222a; --pale: #5b6472; --line: #d4d8de; --panel: #f4f6f8;
  --good: #00704f; --bad: #b34700; }
@media (prefers-color-scheme: dark) { :root { --paper: #14171c; --ink: #e6e9ee; --pale: #a3acb9;
  --line: #353b45; --panel: #1d2128;
  --good: #4bc49a; --bad: #f0a06b; } }
* { box-sizing: border-box; }
body { margin: 0; padding: 1.5rem; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, sans-serif; }
main { max-width: 62rem; margin: 0 auto; }
h1 { font-size: 1.5rem; margin: 0 0 .25rem; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
h3 { font-size: 1rem; margin: 1.25rem 0 .4rem; }
p { margin: .3rem 0; } .pale { color: var(--pale); }
article { border-top: 3px solid var(--line); margin-top: 2.5rem; padding-top: .5rem; }
.verdict { font-weight: 600; } .good { color: var(--good); } .bad { color: var(--bad); }
figure { margin: .5rem 0; } figcaption { color: var(--pale); font-size: .87rem; margin-top: .25rem; }
img { max-width: 100%; height: auto; border: 1px solid var(--line); display: block; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; min-width: 44rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .3rem .7rem .3rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { font-weight: 600; } td.number, th.number { text-align: right; }
code { font: .92em ui-monospace, monospace; overflow-wrap: anywhere; } td code { white-space: nowrap; }
"""


def html_page(
    reports: Sequence[CommandReport] = (), *, overview: Overview | None = None, title: str = "Replay"
) -> str:
    """Return an HTML page with the table of *overview*, if given, and the *reports* of commands."""
    parts = [_overview(overview)] if overview is not None else []
    parts += [_report(report) for report in reports]
    return (
        "<!doctype html>\n"
        '<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_text(_POLICY)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="referrer" content="no-referrer">\n'
        f"<title>{_text(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n<h1>{_text(title)}</h1>\n{''.join(parts)}</main>\n</body>\n</html>\n"
    )


def _overview(seen: Overview) -> str:
    lines = [
        f"{counted(seen.commands, 'command')} of {counted(seen.robots, 'robot')} in {seen.seconds:.1f} s",
        f"{counted(seen.files, 'file')}",
    ]
    if seen.cut:
        lines.append(f"{counted(len(seen.cut), 'file')} cut off, read up to the last whole chunk")
    if seen.was_solved:
        lines.append(f"solved again: {seen.equal} equal to the byte, {seen.different} different")
    rows = [
        [
            trouble.kind,
            f"<code>{_text(trouble.id)}</code>",
            _text(trouble.robot),
            _text(trouble.what),
        ]
        for trouble in seen.troubles
    ]
    table = _table(["what", "command", "robot", "what was seen"], rows)
    by_kind = ", ".join(f"{count} {_text(kind)}" for kind, count in seen.by_kind.items()) or "nothing"
    return f'<p class="pale">{_text("; ".join(lines))}</p>\n<h2>What went wrong: {by_kind}</h2>\n{table}'


def _report(seen: CommandReport) -> str:
    parts = [
        f"<article>\n<h2>Command <code>{_text(seen.id)}</code></h2>\n",
        f'<p class="verdict {_colour(seen.verdict)}">{_text(_verdict(seen.verdict, seen.reason))}</p>\n',
        f"<p>{_text(seen.hint)}</p>\n" if seen.hint else "",
        f"<p>{_equality(seen)}</p>\n",
        f'<p class="pale">{_text(_circumstances(seen))}</p>\n',
        _picture(seen),
        _rules(seen.rules),
        _attempts("What each engine says", "engine", seen.engines),
        _attempts(
            "What other options give", "option", (*([seen.tried] if seen.tried else []), *seen.options), seen
        ),
        "</article>\n",
    ]
    return "".join(parts)


def _verdict(verdict: str, reason: str) -> str:
    return f"{verdict}: {reason}" if reason else verdict


def _colour(verdict: str) -> str:
    return "good" if verdict in ("ok", "answered") else "bad"


def _equality(seen: CommandReport) -> str:
    if seen.why_not:
        return f"It cannot be solved again: {_text(seen.why_not)}."
    if seen.is_equal:
        return "Solved again: the answer is equal to the byte, but for times and places."
    return f'Solved again: <strong class="bad">the answer is different</strong>: {_text(seen.difference)}.'


def _circumstances(seen: CommandReport) -> str:
    lines = [f"{seen.robot} on {seen.server}" if seen.server else seen.robot, f"service {seen.service}"]
    if seen.sent_s > 86400.0:
        when = datetime.fromtimestamp(min(seen.sent_s, 4e9), timezone.utc)
        lines.append(when.strftime("%Y-%m-%d %H:%M:%S UTC"))
    if seen.round_trip_ms is not None:
        lines.append(
            f"{seen.round_trip_ms:.1f} ms ({seen.queue_ms:.1f} ms in the queue, "
            f"{seen.compute_ms:.1f} ms of work)"
        )
    lines.append(f"{seen.command_bytes} bytes up and {seen.reply_bytes} down, codec {seen.codec}")
    if seen.version:
        lines.append(f"rse-pf {seen.version}")
    return "; ".join(lines)


def _picture(seen: CommandReport) -> str:
    if not seen.picture_png:
        return ""
    on = "the thumbnail of the frame" if seen.has_thumbnail else "an empty image: no thumbnail was recorded"
    caption = (
        f"{seen.inliers} inliers of {seen.matches} matches" if seen.inliers else f"{seen.matches} matches"
    )
    data = base64.b64encode(seen.picture_png).decode()
    return (
        f'<h3>The matches</h3>\n<figure><img alt="{_text(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{_text(caption)}, on {on}. Blue dots agree with the pose, orange crosses do not; a "
        "line leads from a match to where the pose puts its point.</figcaption></figure>\n"
    )


def _rules(rules: Sequence[Rule]) -> str:
    if not rules:
        return ""
    rows = []
    for rule in rules:
        says = "kept" if rule.is_satisfied else ("refuses" if rule.refuses else "weak")
        relation = "at least" if rule.at_least else "at most"
        rows.append(
            [
                f'<span class="{"good" if rule.is_satisfied else "bad"}">{says}</span>',
                _text(rule.name),
                _text(rule.about),
                f"{_number(rule.measured)} {_text(rule.unit)}",
                f"{relation} {_number(rule.limit)} {_text(rule.unit)}",
                "" if math.isinf(rule.margin) or rule.margin > 1e4 else f"{rule.margin:.2g}x",
            ]
        )
    head = ["rule", "reason", "what is measured", "measured", "limit", "margin"]
    return f"<h3>The rules of the evidence</h3>\n{_table(head, rows)}"


def _attempts(title: str, first: str, attempts: Sequence[Attempt], seen: CommandReport | None = None) -> str:
    if not attempts:
        return ""
    rows = []
    for attempt in attempts:
        moved = ""
        if attempt.moved_m is not None and attempt.moved_deg is not None:
            moved = f"{_number(1e3 * attempt.moved_m)} mm, {_number(attempt.moved_deg)} deg"
        name = attempt.name or (seen.tried_name if seen is not None else "")
        numbers = [str(attempt.inliers), f"{attempt.rmse_px:.2f}"] if attempt.inliers else ["", ""]
        words = _text(_verdict(attempt.verdict, attempt.reason))
        verdict = f'<span class="{_colour(attempt.verdict)}">{words}</span>'
        rows.append([f"<code>{_text(name)}</code>", verdict, *numbers, moved])
    head = [first, "verdict", "inliers", "rmse px", "apart from the recorded pose"]
    return f"<h3>{_text(title)}</h3>\n{_table(head, rows)}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return an HTML table, empty without rows; headings are escaped here, cells are HTML already."""
    if not rows:
        return ""
    top = "".join(f'<th scope="col">{_text(heading)}</th>' for heading in head)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>\n" for row in rows)
    return f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>\n{body}</tbody></table></div>\n'


def _number(value: float) -> str:
    if abs(value) >= 1e9:
        return "very large"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.3g}"


def _text(text: str) -> str:
    return html.escape(printable(text), quote=True)
