"""The rate rules of the firewall in front of the platform, as the template has them, played on any clock.

AWS WAF estimates the rate of an address several times a minute and blocks it while the estimate is above the
limit; requests that it blocks count, too.  The player is stricter: it counts exactly, at each request.
"""

from __future__ import annotations

import base64
from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.config.front_door import RETRY_AFTER_S, STATUS, RateRule, rate_rules


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """What the firewall answers instead of the platform."""

    status: int
    headers: Mapping[str, str]
    body: bytes


@dataclass(slots=True, kw_only=True)
class PlayedRule:
    """One rule of a template, with the requests that it counts."""

    name: str
    limit: int
    window_s: float
    statement: dict[str, Any] | None
    of_all: bool
    reply: Reply
    _seen: dict[str, deque[float]] = field(default_factory=lambda: defaultdict(deque))

    def blocks(self, address: str, path: str, now: float) -> bool:
        """Count a request of *address*; return whether the rule blocks it."""
        if self.statement is not None and not _matches(self.statement, path):
            return False
        seen = self._seen["" if self.of_all else address]
        seen.append(now)
        while seen[0] <= now - self.window_s:
            seen.popleft()
        return len(seen) > self.limit


class PlayedFirewall:
    """All rules of a template, in their order."""

    def __init__(self, rules: list[PlayedRule]) -> None:
        self.rules = rules
        self.blocked = 0

    def judge(self, address: str, path: str, now: float) -> Reply | None:
        """Return the answer of the first rule that blocks a request, None if it passes."""
        for rule in self.rules:
            if rule.blocks(address, path, now):
                self.blocked += 1
                return rule.reply
        return None


def rules_of_template(template: Mapping[str, Any]) -> list[PlayedRule]:
    """Return the rules of the only web ACL of a CloudFormation *template*."""
    (acl,) = [
        resource["Properties"]
        for resource in template["Resources"].values()
        if resource["Type"] == "AWS::WAFv2::WebACL"
    ]
    bodies = acl.get("CustomResponseBodies", {})
    made = []
    for rule in sorted(acl["Rules"], key=lambda each: int(each["Priority"])):
        rate = rule["Statement"].get("RateBasedStatement")
        if rate is None:  # it judges what a request holds, and counts nothing
            continue
        made.append(
            PlayedRule(
                name=rule["Name"],
                limit=int(rate["Limit"]),
                window_s=float(rate["EvaluationWindowSec"]),
                statement=rate.get("ScopeDownStatement"),
                of_all=rate["AggregateKeyType"] == "CONSTANT",
                reply=_reply(rule["Action"]["Block"], bodies),
            )
        )
    return made


def _reply(block: Mapping[str, Any], bodies: Mapping[str, Any]) -> Reply:
    custom = block.get("CustomResponse")
    if custom is None:
        return Reply(status=403, headers={}, body=b"<html>403 Forbidden</html>")
    body = bodies.get(custom.get("CustomResponseBodyKey", ""), {}).get("Content", "")
    headers = {header["Name"]: header["Value"] for header in custom.get("ResponseHeaders", [])}
    return Reply(status=int(custom["ResponseCode"]), headers=headers, body=body.encode())


def _matches(statement: Mapping[str, Any], path: str) -> bool:
    """Return whether *path* matches a scope-down statement of the kinds that the template uses."""
    ((kind, inside),) = statement.items()
    if kind == "NotStatement":
        return not _matches(inside["Statement"], path)
    if kind == "OrStatement":
        return any(_matches(inner, path) for inner in inside["Statements"])
    if kind == "ByteMatchStatement" and inside["PositionalConstraint"] == "STARTS_WITH":
        encoded = inside.get("SearchStringBase64")
        wanted = inside["SearchString"] if encoded is None else base64.b64decode(encoded).decode()
        return path.startswith(wanted)
    raise ValueError(f"the player knows no statement {kind}")


def rules_of_settings(settings: PlatformSettings) -> list[PlayedRule]:
    """Return the rules that the stacks would write for *settings*, without a synthesis."""
    reply = Reply(status=STATUS, headers={"Retry-After": str(RETRY_AFTER_S)}, body=b"{}")
    return [
        PlayedRule(
            name=rule.name,
            limit=rule.limit,
            window_s=rule.window_s,
            of_all=rule.of_all,
            reply=reply,
            statement=_scope(rule),
        )
        for rule in rate_rules(settings)
    ]


def _scope(rule: RateRule) -> dict[str, Any]:
    either = {"OrStatement": {"Statements": [_begins(path) for path in rule.paths or rule.but]}}
    return either if rule.paths else {"NotStatement": {"Statement": either}}


def _begins(path: str) -> dict[str, Any]:
    return {"ByteMatchStatement": {"PositionalConstraint": "STARTS_WITH", "SearchString": path}}
