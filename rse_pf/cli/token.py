"""Issue a token for a robot, or look into one; make and change the keys of a cloud.

A token is signed with the key of a platform that rse-pf local made, with --key FILE, or with --cloud by the
key in the deployment's secret.  inspect needs no secret: it shows what the token says, and whether the
platform's public keys vouch for it.  init, rotate and retire are for --cloud: the first key, one more that
takes over when every server knows it, and the end of the one before.

examples:
  rse-pf token issue robot-1
  rse-pf token issue robot-1 --life 60
  rse-pf token inspect "$TOKEN"
  rse-pf token init --cloud
  rse-pf token issue robot-1 --cloud
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import secrets
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rse_pf.auth import SigningKey
from rse_pf.errors import ConfigurationError, Unauthorized, UsageError
from rse_pf.settings import PlatformSettings, load_settings

if TYPE_CHECKING:
    from rse_pf.aws.key_store import KeyStore

__all__ = ["add_arguments", "run"]

_NAME = "default"
_LAST_TIME = 1e11
_KEY_ACTIONS = ("init", "rotate", "retire")
_SEED_BYTES = 32


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    life_s = PlatformSettings().auth.token_life_s
    parser.add_argument("action", choices=("issue", "inspect", *_KEY_ACTIONS), help="what to do")
    parser.add_argument(
        "subject", nargs="?", metavar="ROBOT|TOKEN", help="name of the robot; or the token, - reads it"
    )
    parser.add_argument("--cloud", action="store_true", help="the deployment on AWS in cloud.region")
    parser.add_argument("--name", default=_NAME, help=f"which local platform (default: {_NAME})")
    parser.add_argument("--key", type=Path, metavar="FILE", help="issue: sign with this key")
    parser.add_argument(
        "--life",
        type=float,
        metavar="S",
        help=f"issue: life in seconds (auth.token_life_s, default {life_s})",
    )
    parser.add_argument("--keys", type=Path, metavar="FILE", help="inspect: verify with this JWKS")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one action, by the settings that the platform was started with unless told otherwise."""
    if args.action in _KEY_ACTIONS:
        return _change_keys(args, settings)
    if args.subject is None:
        what = "the name of a robot" if args.action == "issue" else "a token"
        raise UsageError(f"rse-pf token {args.action} needs {what}", hint="see rse-pf token --help")
    if args.cloud and args.key is not None:
        raise UsageError("--cloud and --key name two keys", hint="leave one of them out")
    named = args.settings is not None or args.key is not None or args.keys is not None or args.cloud
    chosen = settings if named else _of_platform(args.name) or settings
    if args.action == "issue":
        if args.keys is not None:
            raise UsageError("--keys only checks tokens", hint="name the signing key with --key")
        return _issue(args, chosen)
    if args.key is not None or args.life is not None:
        raise UsageError("--key and --life are for issue only", hint="check a token with --keys JWKS")
    return _inspect(args, chosen)


def _issue(args: argparse.Namespace, settings: PlatformSettings) -> int:
    now = time.time()
    token = _signing_key(args, settings, now).issue(
        args.subject,
        now=now,
        token_id=secrets.token_hex(8),
        settings=settings.auth,
        life_s=args.life,
    )
    print(token)
    return 0


def _signing_key(args: argparse.Namespace, settings: PlatformSettings, now: float) -> SigningKey:
    from rse_pf.local.firewall import key_file, read_key

    if args.cloud:
        return _key_store(settings).ring().signer(now)
    return read_key(args.key if args.key is not None else key_file(_folder(args.name)))


def _change_keys(args: argparse.Namespace, settings: PlatformSettings) -> int:
    from rse_pf.aws.key_store import KeyRing, spread_s

    if not args.cloud or args.subject is not None:
        raise UsageError(
            f"rse-pf token {args.action} is for a cloud, and names no robot",
            hint=f"write rse-pf token {args.action} --cloud; rse-pf local makes its own key",
        )
    store, now = _key_store(settings), time.time()
    new = SigningKey.from_seed(secrets.token_bytes(_SEED_BYTES), secrets.token_hex(8))
    if args.action == "rotate":
        ring = store.ring().rotated(new, now=now, settings=settings)
        store.write(ring)
        print(f"key {new.key_id} is published, and signs in {spread_s(settings):g} s")
        return 0
    if args.action == "retire":
        ring = store.ring().retired(now=now)
        store.write(ring)
        print(f"key {ring.keys[0][0].key_id} alone is trusted; servers know it in {spread_s(settings):g} s")
        return 0
    there = store.read()
    if there is not None:  # perhaps it was never published
        store.publish(there)
        print(f"key {there.signer(now).key_id} is there already; its public half is published again")
        return 0
    store.write(KeyRing(keys=((new, now),)))
    print(f"key {new.key_id} is made; servers know it in {spread_s(settings):g} s")
    return 0


def _key_store(settings: PlatformSettings) -> KeyStore:
    from rse_pf.aws.account import open_account
    from rse_pf.aws.key_store import open_key_store

    return open_key_store(open_account(settings.cloud.region))


def _inspect(args: argparse.Namespace, settings: PlatformSettings) -> int:
    token = sys.stdin.readline().strip() if args.subject == "-" else args.subject.strip()
    header, claims = _parts(token)
    now = time.time()
    verdict, code = _verdict(token, _keys(args, settings), now, settings)
    told = {"header": header, "claims": claims, "seconds_left": _left(claims, now), "verified": verdict}
    print(json.dumps(told, indent=2))
    return code


def _left(claims: dict[str, Any], now: float) -> int | None:
    over = claims.get("exp")
    known = isinstance(over, (int, float)) and not isinstance(over, bool) and abs(over) < _LAST_TIME
    return round(over - now) if known and over is not None else None


def _parts(token: str) -> tuple[dict[str, Any], dict[str, Any]]:
    parts = token.split(".")
    try:
        if len(parts) != 3:
            raise ValueError("not three parts")
        header, claims = (json.loads(_unb64(part)) for part in parts[:2])
    except (ValueError, RecursionError) as error:
        raise UsageError("this is no token", hint="paste what rse-pf token issue printed") from error
    if not isinstance(header, dict) or not isinstance(claims, dict):
        raise UsageError("this is no token", hint="paste what rse-pf token issue printed")
    return header, claims


def _verdict(token: str, keys: Any, now: float, settings: PlatformSettings) -> tuple[str, int]:
    from rse_pf.auth import token_problem, verify_token

    if keys is None:
        return "unknown: no public keys at hand; name them with --keys", 0
    try:
        verify_token(token, keys=keys, now=now, settings=settings.auth)
    except Unauthorized as error:
        return f"no: {token_problem(error)}", 1
    return "yes", 0


def _keys(args: argparse.Namespace, settings: PlatformSettings) -> Any:
    """Return the public keys that were named, or the platform's; None if it has none."""
    from rse_pf.auth import KeySet
    from rse_pf.local.firewall import key_set_file

    if args.cloud:
        return _key_store(settings).ring().key_set()
    path = args.keys if args.keys is not None else key_set_file(_folder(args.name))
    try:
        return KeySet.from_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        if args.keys is None:
            return None
        raise UsageError(f"there is no file {path}", hint="name a JWKS with --keys") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"cannot read {path}", hint="name a JWKS with --keys") from error


def _of_platform(name: str) -> PlatformSettings | None:
    from rse_pf.local.state import settings_file

    path = settings_file(_folder(name))
    return load_settings(path) if path.exists() else None


def _folder(name: str) -> Path:
    from rse_pf.local.state import state_folder

    return state_folder(name, os.environ)


def _unb64(text: str) -> bytes:
    return base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)
