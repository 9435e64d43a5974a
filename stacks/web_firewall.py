"""The web application firewall in front of the load balancer: rate limits of each client address.

The limits come from `rse_pf.config.front_door`.  Requests above a limit get 429 with ``Retry-After`` and
never 403: robots retry after 429, and treat 403 as the permanent refusal of a server.  Requests to the
serverless PnP without a header in the form of a bearer token get 401, because each call of that function is
paid; this rule comes first, so that such requests do not count in the rate of all robots.
"""

from __future__ import annotations

import json

from aws_cdk import aws_wafv2 as wafv2
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.front_door import (
    BEARER_PATTERN,
    BURST_PATH,
    RETRY_AFTER_S,
    STATUS,
    RateRule,
    rate_rules,
)
from rse_pf.config.resource_names import ResourceNames

__all__ = ["WebFirewall"]

_RATE_BODY = "too-fast"  # name in the web ACL of the body of replies to requests above a rate limit
_RATE_TEXT = {
    "code": "quota",
    "message": "too many requests",
    "hint": (
        f"wait {RETRY_AFTER_S} s; operators raise cloud.robots_per_site if many robots share an address, "
        "and burst.commands_per_5_minutes for commands sent to the function"
    ),
}
_BURST_RULE = "burst-needs-a-token"
_UNAUTHORIZED_BODY = "no-token"  # name in the web ACL of the body of replies to requests without a token
_UNAUTHORIZED_STATUS = 401
_UNAUTHORIZED_TEXT = {
    "code": "unauthorized", "message": "the token is missing or not valid",
    "hint": "issue one with rse-pf token issue ROBOT",
}  # fmt: skip


class WebFirewall(Construct):
    """A web ACL (a list of rules of AWS WAF) with the rate rules, attached to the load balancer *alb_arn*."""

    def __init__(
        self, scope: Construct, construct_id: str, *, alb_arn: str, settings: PlatformSettings
    ) -> None:
        super().__init__(scope, construct_id)
        names, rates = ResourceNames(settings.cloud.name), rate_rules(settings)
        acl = wafv2.CfnWebACL(
            self, "Acl", scope="REGIONAL", visibility_config=_metrics_only(names.firewall),
            default_action=wafv2.CfnWebACL.DefaultActionProperty(allow={}),
            custom_response_bodies={
                _RATE_BODY: wafv2.CfnWebACL.CustomResponseBodyProperty(
                    content=json.dumps(_RATE_TEXT), content_type="APPLICATION_JSON"
                ),
                _UNAUTHORIZED_BODY: wafv2.CfnWebACL.CustomResponseBodyProperty(
                    content=json.dumps(_UNAUTHORIZED_TEXT), content_type="APPLICATION_JSON"
                ),
            },
            rules=[
                _burst_token_rule(names.prefix, 0),
                *(_rule(names.prefix, place, rule) for place, rule in enumerate(rates, start=1)),
            ],
        )  # fmt: skip
        wafv2.CfnWebACLAssociation(self, "OfAlb", resource_arn=alb_arn, web_acl_arn=acl.attr_arn)


def _rule(prefix: str, place: int, rule: RateRule) -> wafv2.CfnWebACL.RuleProperty:
    return wafv2.CfnWebACL.RuleProperty(
        name=rule.name, priority=place, visibility_config=_metrics_only(f"{prefix}-{rule.name}"),
        action=wafv2.CfnWebACL.RuleActionProperty(
            block=wafv2.CfnWebACL.BlockActionProperty(
                custom_response=wafv2.CfnWebACL.CustomResponseProperty(
                    response_code=STATUS, custom_response_body_key=_RATE_BODY,
                    response_headers=[
                        wafv2.CfnWebACL.CustomHTTPHeaderProperty(name="Retry-After", value=str(RETRY_AFTER_S))
                    ],
                )
            )
        ),
        statement=wafv2.CfnWebACL.StatementProperty(
            rate_based_statement=wafv2.CfnWebACL.RateBasedStatementProperty(
                aggregate_key_type="CONSTANT" if rule.of_all else "IP", limit=rule.limit,
                evaluation_window_sec=rule.window_s, scope_down_statement=_statement_of_paths(rule),
            )
        ),
    )  # fmt: skip


def _burst_token_rule(prefix: str, place: int) -> wafv2.CfnWebACL.RuleProperty:
    """Return the rule that blocks requests to the serverless PnP without a header in the form of a token.

    Each call of that function is paid.
    """
    has_bearer_token = wafv2.CfnWebACL.StatementProperty(
        regex_match_statement=wafv2.CfnWebACL.RegexMatchStatementProperty(
            field_to_match=wafv2.CfnWebACL.FieldToMatchProperty(single_header={"Name": "authorization"}),
            regex_string=BEARER_PATTERN,
            text_transformations=[wafv2.CfnWebACL.TextTransformationProperty(priority=0, type="NONE")],
        )
    )
    other = wafv2.CfnWebACL.StatementProperty(
        not_statement=wafv2.CfnWebACL.NotStatementProperty(statement=has_bearer_token)
    )
    return wafv2.CfnWebACL.RuleProperty(
        name=_BURST_RULE, priority=place, visibility_config=_metrics_only(f"{prefix}-{_BURST_RULE}"),
        action=wafv2.CfnWebACL.RuleActionProperty(
            block=wafv2.CfnWebACL.BlockActionProperty(
                custom_response=wafv2.CfnWebACL.CustomResponseProperty(
                    response_code=_UNAUTHORIZED_STATUS, custom_response_body_key=_UNAUTHORIZED_BODY
                )
            )
        ),
        statement=wafv2.CfnWebACL.StatementProperty(
            and_statement=wafv2.CfnWebACL.AndStatementProperty(
                statements=[_path_begins_with(BURST_PATH), other]
            )
        ),
    )  # fmt: skip


def _statement_of_paths(rule: RateRule) -> wafv2.CfnWebACL.StatementProperty:
    if rule.paths:
        return _path_begins_with_one_of(rule.paths)
    return wafv2.CfnWebACL.StatementProperty(
        not_statement=wafv2.CfnWebACL.NotStatementProperty(statement=_path_begins_with_one_of(rule.but))
    )


def _path_begins_with_one_of(paths: tuple[str, ...]) -> wafv2.CfnWebACL.StatementProperty:
    statements = [_path_begins_with(path) for path in paths]
    if len(statements) == 1:  # AWS refuses an OrStatement with a single statement
        return statements[0]
    return wafv2.CfnWebACL.StatementProperty(
        or_statement=wafv2.CfnWebACL.OrStatementProperty(statements=statements)
    )


def _path_begins_with(path: str) -> wafv2.CfnWebACL.StatementProperty:
    return wafv2.CfnWebACL.StatementProperty(
        byte_match_statement=wafv2.CfnWebACL.ByteMatchStatementProperty(
            field_to_match=wafv2.CfnWebACL.FieldToMatchProperty(uri_path={}), search_string=path,
            positional_constraint="STARTS_WITH",
            text_transformations=[wafv2.CfnWebACL.TextTransformationProperty(priority=0, type="NONE")],
        )
    )  # fmt: skip


def _metrics_only(name: str) -> wafv2.CfnWebACL.VisibilityConfigProperty:
    # Sampled requests are off: AWS would show their headers, and so the robots' tokens, for hours.
    return wafv2.CfnWebACL.VisibilityConfigProperty(
        cloud_watch_metrics_enabled=True, metric_name=name, sampled_requests_enabled=False
    )
