"""Least privilege: each action of each role has a line of code that needs it, and no role has another."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.config.cloud_layout import ENDPOINT_SERVICES

Assembly = Any

BY_AWS = "aws: "
USED_BY = "rse-pf:used-by"
CALLS = {
    "s3:GetObject": ("get_object", "urlopen"),
    "s3:PutObject": ("put_object", "urlopen"),
    # Without it S3 answers 403 for an object that does not exist, so every reader needs it.
    "s3:ListBucket": ("list_objects_v2", "get_object", "urlopen"),
    "secretsmanager:GetSecretValue": ("get_secret_value", "urlopen"),
}
"""What makes the call where it is not the action's name in small letters: the Lambda has no boto3."""
SERVICES_OF_ENDPOINTS = {"monitoring": "cloudwatch", "autoscaling": "autoscaling"}


@dataclass(frozen=True)
class Role:
    """One role of a stack: its path in the tree of constructs, its actions, and who is said to use them."""

    path: str
    actions: frozenset[str]
    uses: tuple[tuple[str, str], ...]
    """Pairs of an action and a user."""


def statements(resource: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield what a role or a policy allows."""
    properties = resource["Properties"]
    documents = [each["PolicyDocument"] for each in properties.get("Policies", [])]
    documents += [properties["PolicyDocument"]] if "PolicyDocument" in properties else []
    for document in documents:
        yield from (each for each in document["Statement"] if each["Effect"] == "Allow")


def as_list(value: str | list[str]) -> list[str]:
    return [value] if isinstance(value, str) else value


def roles_of(assembly: Assembly) -> list[Role]:
    """Return every role of every template with its actions, CDK-made ones included."""
    found = []
    for stack, template in assembly.templates.items():
        metadata = json.loads((assembly.folder / f"{stack}.metadata.json").read_text(encoding="utf-8"))
        paths = {
            each["data"]: path
            for path, rows in metadata.items()
            for each in rows
            if each["type"] == "aws:cdk:logicalId"
        }
        uses = [
            (path, action, user)
            for path, rows in metadata.items()
            for each in rows
            if each["type"] == USED_BY
            for action in each["data"]["actions"]
            for user in each["data"]["used_by"]
        ]
        resources = template["Resources"]
        for name, role in resources.items():
            if role["Type"] != "AWS::IAM::Role":
                continue
            assert not role["Properties"].get("ManagedPolicyArns"), f"{name} has actions that nobody lists"
            policies = [
                each
                for each in resources.values()
                if each["Type"] in ("AWS::IAM::Policy", "AWS::IAM::ManagedPolicy")
                and {"Ref": name} in each["Properties"].get("Roles", [])
            ]
            actions = {
                action
                for each in (role, *policies)
                for statement in statements(each)
                for action in as_list(statement["Action"])
            }
            path = paths[name]
            ours = tuple((action, user) for where, action, user in uses if path.startswith(f"{where}/"))
            found.append(Role(path, frozenset(actions), ours))
    return found


def source_of(user: str, repository: Path) -> str:
    """Return the source of a function, class or method ``path.py:Name.name``; of a file without a colon."""
    path, _, name = user.partition(":")
    text = (repository / path).read_text(encoding="utf-8")
    if not name:
        return text
    body: Any = ast.parse(text)
    for word in name.split("."):
        kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
        (body,) = [each for each in body.body if isinstance(each, kinds) and each.name == word]
    return str(ast.get_source_segment(text, body))


def calls(action: str, source: str) -> bool:
    """Return whether *source* makes the call that needs *action*: a method, or its name as a text."""
    name = re.sub(r"(?<!^)(?=[A-Z])", "_", action.partition(":")[2]).lower()
    return any(re.search(rf"\b{each}\b", source) for each in CALLS.get(action, (name,)))


def test_every_action_of_every_role_has_a_user_in_code(assembly: Assembly, repository: Path) -> None:
    roles = roles_of(assembly)

    assert len(roles) >= 3
    without = [
        f"{role.path}: {action}"
        for role in roles
        for action in sorted(role.actions)
        if not any(
            user.startswith(BY_AWS) or calls(action, source_of(user, repository))
            for used, user in role.uses
            if used == action
        )
    ]
    assert without == [], "actions without a user"


def test_no_action_is_a_wildcard(assembly: Assembly) -> None:
    wide = {action for role in roles_of(assembly) for action in role.actions if "*" in action}

    assert wide == set()


def test_every_endpoint_has_an_action_that_a_role_of_the_servers_uses(assembly: Assembly) -> None:
    endpoints = [
        each for each in assembly.all("AWS::EC2::VPCEndpoint") if each.get("VpcEndpointType") == "Interface"
    ]
    services = {str(each["ServiceName"]).rpartition(".")[2] for each in endpoints}
    (servers,) = [role for role in roles_of(assembly) if role.path.endswith("/Servers/Role/Resource")]
    used = {action.partition(":")[0] for action in servers.actions}

    assert services == set(ENDPOINT_SERVICES)
    assert {SERVICES_OF_ENDPOINTS[each] for each in services} <= used
