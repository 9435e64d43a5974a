"""T1: what is no good token opens nothing, whatever is wrong with it, and everybody hears the same words."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import json
import os
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest

from rse_pf.auth.roster import DenyList, EnrolledRobot, Roster, public_key_of
from rse_pf.auth.tokens import SigningKey
from tests.kit.guarded_server import KEY, GuardedServer

pytestmark = pytest.mark.system

_AT_ONCE = 8
ROBOT = SigningKey.of_robot(b"r" * 32)
STRANGER = SigningKey.of_robot(b"s" * 32)


def unb64(text: str) -> bytes:
    return base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))


def b64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def resigned(token: str, header: dict[str, Any], claims: dict[str, Any]) -> str:
    """Return the token with changed parts and its old signature."""
    old_header, old_claims, signature = token.split(".")
    parts = [{**json.loads(unb64(old_header)), **header}, {**json.loads(unb64(old_claims)), **claims}]
    kept = [{name: value for name, value in part.items() if value is not ...} for part in parts]
    return ".".join([*(b64(json.dumps(part).encode()) for part in kept), signature])


def by_hmac(token: str, secret: bytes, alg: str = "HS256") -> str:
    """Return the token signed with a public key taken for a shared secret (RFC 8725, Sect. 2.1)."""
    header, claims, _ = resigned(token, {"alg": alg}, {}).split(".")
    mark = hmac.new(secret, f"{header}.{claims}".encode(), hashlib.sha256).digest()
    return f"{header}.{claims}.{b64(mark)}"


def signed(key: SigningKey, claims: dict[str, Any], header: dict[str, Any] | None = None) -> str:
    """Return what *key* signs, however absurd."""
    import jwt

    heads = {"kid": key.key_id, "typ": "robot+jwt", **(header or {})}
    return jwt.encode(claims, key._private, algorithm="EdDSA", headers=heads)


def mutated(server: GuardedServer) -> Iterator[tuple[str, bytes]]:
    """Yield a name and a header for each way in which a token can be wrong."""
    good = server.token("robot-1")
    now = time.time()
    head, body, mark = good.split(".")
    claims = json.loads(unb64(body))
    public = json.loads(KEY.public_json())["x"]
    whole: dict[str, str] = {
        "empty": "", "word": "x", "dots": "..", "no signature": f"{head}.{body}.",
        "two parts": f"{head}.{body}",
        "four parts": f"{good}.x", "padded": good + "=", "doubled": good + good, "reversed": good[::-1],
        "swapped": f"{body}.{head}.{mark}", "swapped mark": f"{head}.{mark}.{body}",
        "unknown key": signed(SigningKey.from_seed(b"o" * 32, "other"), claims),
        "our key id": signed(SigningKey.from_seed(b"o" * 32, KEY.key_id), claims),
        "stranger": signed(STRANGER, claims),
        "robot's for another": signed(ROBOT, {**claims, "sub": "robot-2"}),
        "robot's key id": signed(KEY, claims, {"kid": ROBOT.key_id}),
        "expired": signed(KEY, {**claims, "iat": int(now) - 900, "exp": int(now) - 60}),
        "not yet": signed(KEY, {**claims, "nbf": int(now) + 120}),
        "from the future": signed(KEY, {**claims, "iat": int(now) + 120, "exp": int(now) + 600}),
        "too long a life": signed(KEY, {**claims, "exp": int(now) + 86400}),
        "too long": signed(KEY, {**claims, "filling": "x" * 5000}),
        "crit": signed(KEY, claims, {"crit": ["exp"]}), "plain jwt": signed(KEY, claims, {"typ": "JWT"}),
        "no type": signed(KEY, claims, {"typ": None}), "revoked": signed(KEY, {**claims, "jti": "revoked"}),
        "disabled": signed(KEY, {**claims, "sub": "disabled"}),
        "too early": signed(KEY, {**claims, "sub": "renewed"}),
    }  # fmt: skip
    for alg in (
        "none",
        "None",
        "NONE",
        "nOnE",
        "HS256",
        "HS512",
        "RS256",
        "ES256",
        "PS256",
        "Ed25519",
        "",
        "EdDSA ",
    ):
        whole[f"alg {alg!r}"] = resigned(good, {"alg": alg}, {})
        whole[f"alg {alg!r}, unsigned"] = resigned(good, {"alg": alg}, {}).rpartition(".")[0] + "."
        for name, secret in {"text": public.encode(), "bytes": unb64(public), "": b""}.items():
            whole[f"hmac {alg!r} of {name}"] = by_hmac(good, secret, alg)
    for name in ("iss", "aud", "sub", "exp", "iat", "jti"):
        whole[f"no {name}"] = signed(KEY, {key: value for key, value in claims.items() if key != name})
        for odd in (None, 0, -1, True, 1e300, "", "x" * 65, [], {}, ["rse-pf", "y"][1:]):
            if not (name == "sub" and odd == "") and not (name in ("iss", "aud") and odd == "rse-pf"):
                whole[f"{name} {odd!r}"[:80]] = resigned(good, {}, {name: odd})
        for odd in (-1, 1e300, "1", [], {}):
            if name in ("exp", "iat"):
                whole[f"signed {name} {odd!r}"] = signed(KEY, {**claims, name: odd})
        if name not in ("exp", "iat", "jti", "sub"):
            whole[f"signed {name}"] = signed(KEY, {**claims, name: "another"})
    for kid in (
        None,
        "",
        "../../keys",
        "robot:",
        ROBOT.key_id,
        "' OR 1=1 --",
        7,
        ["guard-1"],
        {},
        "guard-1\x00",
    ):
        whole[f"kid {kid!r}"] = resigned(good, {"kid": kid}, {})
    for name in ("jku", "jwk", "x5u", "x5c"):
        whole[name] = signed(KEY, claims, {name: "https://example.org/keys.json", "kid": "other"})
    for length in range(0, len(good), 7):
        whole[f"cut at {length}"] = good[:length]
    for name, token in whole.items():
        yield name, b"Bearer " + token.encode()
    for scheme in (b"", b"Basic ", b"bearer", b"Bearer", b"Token ", b"Bearer\t\t,"):
        yield f"scheme {scheme!r}", scheme + good.encode()
    yield "two tokens", b"Bearer " + good.encode() + b" " + good.encode()
    yield "a comma", b"Bearer " + good.encode() + b", Bearer x"
    yield "high bytes", b"Bearer " + bytes(range(128, 256))
    yield "100 kB", b"Bearer " + b"x" * 7000


async def answers(server: GuardedServer, headers: list[bytes]) -> list[tuple[int, bytes]]:
    """Return the answer to each header, a few handshakes at a time."""
    gate = asyncio.Semaphore(_AT_ONCE)

    async def one(header: bytes) -> tuple[int, bytes]:
        async with gate:
            return await server.handshake(header)

    return await asyncio.gather(*map(one, headers))


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GuardedServer]:
    server = GuardedServer(tmp_path_factory.mktemp("guarded"))
    (server.folder / "settings.json").chmod(0o600)
    robots = (
        EnrolledRobot(robot="robot-1", x=public_key_of(ROBOT.public_json())),
        EnrolledRobot(robot="lost", x=public_key_of(STRANGER.public_json())),
    )
    server.access.change_roster(lambda _: Roster(robots=robots))

    def denied(_: DenyList) -> DenyList:
        fresh = DenyList().with_robot("default", "disabled", 0.0).with_robot("default", "lost", 0.0)
        fresh = fresh.with_tokens_before("default", "renewed", time.time() + 600)
        return fresh.with_token("default", "robot-1", "revoked", time.time() + 900)

    server.access.change_deny_list(denied)
    with server:
        yield server


def test_every_mutated_token_is_rejected_with_the_same_answer(server: GuardedServer) -> None:
    wrong = list(mutated(server))

    got = asyncio.run(answers(server, [header for _, header in wrong]))

    by_answer: dict[tuple[int, bytes], list[str]] = {}
    for (name, _), answer in zip(wrong, got, strict=True):
        by_answer.setdefault(answer, []).append(name)
    print(f"{len(wrong)} tokens: { ({key: len(names) for key, names in by_answer.items()}) }")
    assert len(wrong) >= 200
    assert {status for status, _ in by_answer} == {401}, {k: v[:5] for k, v in by_answer.items()}
    assert len(by_answer) == 1
    assert '"defect"' not in server.log


def test_a_robot_that_proves_its_key_is_told_that_it_is_disabled(server: GuardedServer) -> None:
    _, body, _ = server.token("robot-1").split(".")
    token = signed(STRANGER, {**json.loads(unb64(body)), "sub": "lost"})

    [(status, body)] = asyncio.run(answers(server, [b"Bearer " + token.encode()]))

    assert (status, json.loads(body)["cause"]) == (401, "disabled")


def test_valid_tokens_of_the_platform_and_of_the_robot_are_accepted(server: GuardedServer) -> None:
    own = ROBOT.issue("robot-1", now=time.time(), token_id="own", settings=server.settings.auth)
    headers = [f"Bearer {token}".encode() for token in (server.token("robot-1"), own)]

    assert [status for status, _ in asyncio.run(answers(server, headers))] == [101, 101]


@pytest.mark.slow
def test_every_token_with_one_bit_flipped_is_rejected(server: GuardedServer) -> None:
    good = server.token("robot-1").encode()
    flipped = [
        good[:place] + bytes([good[place] ^ 1 << bit]) + good[place + 1 :]
        for place in range(len(good))
        for bit in range(8)
    ]
    load = os.getloadavg()[0]

    got = asyncio.run(answers(server, [b"Bearer " + token for token in flipped]))

    counts = Counter(status for status, _ in got)
    print(f"{len(flipped)} flips: {dict(counts)}; load {load:.1f}")
    breaks_the_header = [token for token, (status, _) in zip(flipped, got, strict=True) if status != 401]
    assert counts[101] == 0
    assert not [status for status in counts if status >= 500]
    assert all(any(sign < 32 or sign == 127 for sign in token) for token in breaks_the_header)
    assert len({body for status, body in got if status == 401}) == 1
    assert '"defect"' not in server.log
