"""The web application firewall in front of the load balancer: how fast one address may ask for what.

The limits come from `rse_pf.config.front_door`.  Blocked requests get 429 with ``Retry-After`` and never 403:
a robot must be able to tell a firewall that it should wait for from a server that refuses it for good.
"""

from __future__ import annotations

import json

from aws_cdk import aws_wafv2 as wafv2
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.front_door import RETRY_AFTER_S, STATUS, RateRule, rate_rules
from rse_pf.config.resource_names import ResourceNames

__all__ = ["WebFirewall"]

_BODY = "too-fast"
_TOLD = {
    "code": "quota",
    "message": "too many requests of this address",
    "hint": f"wait {RETRY_AFTER_S} s; if many robots share the address, raise cloud.robots_per_site",
}


class WebFirewall(Construct):
    """A web ACL of rate rules for the load balancer *alb_arn*."""

    def __init__(
        self, scope: Construct, construct_id: str, *, alb_arn: str, settings: PlatformSettings
    ) -> None:
        super().__init__(scope, construct_id)
        names = ResourceNames(settings.cloud.name)
        acl = wafv2.CfnWebACL(
            self, "Acl", scope="REGIONAL", visibility_config=_seen(names.firewall),
            default_action=wafv2.CfnWebACL.DefaultActionProperty(allow={}),
            custom_response_bodies={
                _BODY: wafv2.CfnWebACL.CustomResponseBodyProperty(
                    content=json.dumps(_TOLD), content_type="APPLICATION_JSON"
                )
            },
            rules=[_rule(names.prefix, place, rule) for place, rule in enumerate(rate_rules(settings))],
        )  # fmt: skip
        wafv2.CfnWebACLAssociation(self, "OfAlb", resource_arn=alb_arn, web_acl_arn=acl.attr_arn)


def _rule(prefix: str, place: int, rule: RateRule) -> wafv2.CfnWebACL.RuleProperty:
    return wafv2.CfnWebACL.RuleProperty(
        name=rule.name, priority=place, visibility_config=_seen(f"{prefix}-{rule.name}"),
        action=wafv2.CfnWebACL.RuleActionProperty(
            block=wafv2.CfnWebACL.BlockActionProperty(
                custom_response=wafv2.CfnWebACL.CustomResponseProperty(
                    response_code=STATUS, custom_response_body_key=_BODY,
                    response_headers=[
                        wafv2.CfnWebACL.CustomHTTPHeaderProperty(name="Retry-After", value=str(RETRY_AFTER_S))
                    ],
                )
            )
        ),
        statement=wafv2.CfnWebACL.StatementProperty(
            rate_based_statement=wafv2.CfnWebACL.RateBasedStatementProperty(
                aggregate_key_type="CONSTANT" if rule.of_all else "IP", limit=rule.limit,
                evaluation_window_sec=rule.window_s, scope_down_statement=_scope(rule),
            )
        ),
    )  # fmt: skip


def _scope(rule: RateRule) -> wafv2.CfnWebACL.StatementProperty:
    if rule.path:
        return _begins(rule.path)
    others = [_begins(path) for path in rule.but]
    either = wafv2.CfnWebACL.StatementProperty(
        or_statement=wafv2.CfnWebACL.OrStatementProperty(statements=others)
    )
    return wafv2.CfnWebACL.StatementProperty(
        not_statement=wafv2.CfnWebACL.NotStatementProperty(statement=either)
    )


def _begins(path: str) -> wafv2.CfnWebACL.StatementProperty:
    return wafv2.CfnWebACL.StatementProperty(
        byte_match_statement=wafv2.CfnWebACL.ByteMatchStatementProperty(
            field_to_match=wafv2.CfnWebACL.FieldToMatchProperty(uri_path={}), search_string=path,
            positional_constraint="STARTS_WITH",
            text_transformations=[wafv2.CfnWebACL.TextTransformationProperty(priority=0, type="NONE")],
        )
    )  # fmt: skip


def _seen(name: str) -> wafv2.CfnWebACL.VisibilityConfigProperty:
    # Samples would show the headers of handshakes, and so the tokens of robots, for hours.
    return wafv2.CfnWebACL.VisibilityConfigProperty(
        cloud_watch_metrics_enabled=True, metric_name=name, sampled_requests_enabled=False
    )
