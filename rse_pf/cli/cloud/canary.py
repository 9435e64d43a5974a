"""rse-pf cloud canary: give the canary's robot a new key, and enrol it; its old key is refused then."""

from __future__ import annotations

import json
import secrets
import time

from rse_pf.command_line.options import Action, NoOptions
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.terminal import show

__all__ = ["ACTION"]

# Random bytes from which the private key (Ed25519) of the canary's robot is made.
_SEED_BYTES = 32


def renew_canary_key(request: NoOptions, settings: PlatformSettings) -> int:
    """Make a key, write it into the canary's secret and its public half into the roster, and return 0.

    The canary is a function on AWS that requests one known pose every minute, like a robot; without a key its
    alarm fires.
    """
    from rse_pf.auth.roster import SYNTHETIC, EnrolledRobot
    from rse_pf.auth.tokens import SigningKey
    from rse_pf.aws.account import open_account
    from rse_pf.aws.storage.key_store import open_key_store

    if not settings.cloud.canary:
        raise UsageError("cloud.canary is off", hint='set it to true in cdk.json, context."rse-pf"')
    account, names = open_account(settings.cloud.region), ResourceNames(settings.cloud.name)
    access = open_key_store(account, names).access_control_store()
    secret = account.resource(names.stack("Observability"), "AWS::SecretsManager::Secret", "CanaryKey")
    key = SigningKey.of_robot(secrets.token_bytes(_SEED_BYTES))
    public = json.loads(key.public_json())["x"]
    scopes = ("services:pnp", SYNTHETIC)
    robot = EnrolledRobot(robot=names.canary, x=public, scopes=scopes, enrolled_s=round(time.time(), 3))
    account.change("secretsmanager", "put_secret_value", SecretId=secret, SecretString=key.to_json())
    access.change_roster(lambda roster: roster.enrolled(robot))
    show(f"{names.canary} has a new key and the scopes {' '.join(scopes)}; servers know it in a few seconds")
    return 0


ACTION = Action(help="give the canary a new key, and enrol it", request=NoOptions, run=renew_canary_key)
