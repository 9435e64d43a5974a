"""The signing keys of a cloud: private keys in one secret, public keys as a JWKS in the artifact bucket.

Two keys overlap in a rotation: servers fetch the new public key before tokens are signed with the new key,
and the old one stays until its last token has expired.  No private key appears in an error message or a log
line, and a public key is published only after its private key was stored.  `rse-pf token --cloud` reads the
secret; servers never do.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

from rse_pf.auth.tokens import KeySet, SigningKey
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.aws.account import Account
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import KEYS_NAME, ResourceNames
from rse_pf.errors import ConfigurationError, NotFound, UsageError

__all__ = ["KEYS_NAME", "KeyRing", "KeyStore", "open_key_store", "spread_s"]

_MAKE_ONE = "make one with rse-pf token init --cloud"


def spread_s(settings: PlatformSettings) -> float:
    """Return the seconds after which every server and function has fetched a new key set."""
    return 2.0 * settings.scaling.period_s


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyRing:
    """The signing keys, oldest first, each with the Unix time (s) from which it may sign tokens."""

    keys: tuple[tuple[SigningKey, float], ...]

    @classmethod
    def from_json(cls, text: str) -> KeyRing | None:
        """Return the ring in *text*, which `to_json` wrote; None if the secret holds no keys yet.

        Raises:
            ConfigurationError: The text holds keys that cannot be read.
        """
        try:
            document = json.loads(text)
            rows = document["keys"]
        except (ValueError, TypeError, KeyError):
            return None
        try:
            keys = tuple((SigningKey.from_json(json.dumps(row["jwk"])), float(row["from_s"])) for row in rows)
        except (TypeError, KeyError, ValueError, UsageError) as error:
            raise ConfigurationError(
                "the secret holds keys that cannot be read", hint="restore its version AWSPREVIOUS"
            ) from error
        return cls(keys=keys) if keys else None

    def to_json(self) -> str:
        """Return the ring with its private keys as JSON text, which must be stored only in the secret."""
        rows = [{"jwk": json.loads(key.to_json()), "from_s": from_s} for key, from_s in self.keys]
        return json.dumps({"keys": rows})

    def key_set(self) -> KeySet:
        """Return the public keys of the ring."""
        halves = {key.key_id: key.key_set().get(key.key_id) for key, _ in self.keys}
        return KeySet({name: half for name, half in halves.items() if half is not None})

    def signer(self, now: float) -> SigningKey:
        """Return the newest key that may sign at *now* (Unix s); the oldest key if none may sign yet."""
        may = [key for key, from_s in self.keys if from_s <= now]
        return may[-1] if may else self.keys[0][0]

    def rotated(self, key: SigningKey, *, now: float, settings: PlatformSettings) -> KeyRing:
        """Return a ring of the newest key and the new *key*, which signs `spread_s` after *now* (Unix s).

        Raises:
            ConfigurationError: Tokens of the key that would be dropped are still valid.
        """
        _, from_s = self.keys[-1]
        old_tokens_over = from_s + settings.auth.token_ttl_s + settings.auth.leeway_s
        if len(self.keys) > 1 and now < old_tokens_over:
            raise ConfigurationError(
                f"tokens of the previous key are valid for {old_tokens_over - now:.0f} s more",
                hint="wait, or end them at once with rse-pf token retire --cloud",
            )
        return KeyRing(keys=(self.keys[-1], (key, now + spread_s(settings))))

    def retired(self, *, now: float, force: bool = False) -> KeyRing:
        """Return a ring of the newest key only, which signs from *now* (Unix s) on.

        Servers then refuse the tokens of the other keys.

        Raises:
            ConfigurationError: There is only one key; or *force* is false and servers may not have fetched
                the newest key yet, so that they would refuse all robots for some time.
        """
        if len(self.keys) == 1:
            raise ConfigurationError(
                "there is one key only, and every token is signed with it",
                hint="add another with rse-pf token rotate --cloud first",
            )
        key, from_s = self.keys[-1]
        if now < from_s and not force:
            raise ConfigurationError(
                f"servers may lack key {key.key_id} and refuse robots for {from_s - now:.0f} s more",
                hint="wait; if the previous key was stolen, add --force",
            )
        return KeyRing(keys=((key, min(from_s, now)),))


class KeyStore:
    """The secret that holds the signing keys of one deployment, and the bucket with their public keys."""

    def __init__(self, account: Account, *, secret: str, bucket: str) -> None:
        self._account = account
        self._secret = secret
        self._bucket = S3Store(account.client("s3"), bucket)

    def read(self) -> KeyRing | None:
        """Read and return the ring in the secret; None if no key was made yet.

        Raises:
            ConfigurationError: AWS refused, or the secret holds keys that cannot be read.
            StoreError: AWS does not answer.
        """
        secret = self._account.find("secretsmanager", "get_secret_value", SecretId=self._secret)
        return None if secret is None else KeyRing.from_json(secret["SecretString"])

    def ring(self) -> KeyRing:
        """Read and return the ring in the secret; raises ConfigurationError if no key was made yet."""
        ring = self.read()
        if ring is None:
            raise ConfigurationError("this cloud has no signing key yet", hint=_MAKE_ONE)
        return ring

    def write(self, ring: KeyRing) -> None:
        """Store *ring* in the secret, then publish its public keys.

        After a crash between the two steps, `publish` completes them.

        Raises:
            NotFound: There is no such secret.
            ConfigurationError: AWS refused.
        """
        secret = {"SecretId": self._secret, "SecretString": ring.to_json()}
        if self._account.find("secretsmanager", "put_secret_value", **secret) is None:
            raise NotFound(
                f"no secret named {self._secret!r}", hint="deploy the platform first: rse-pf cloud up"
            )
        self.publish(ring)

    def access_control_store(self) -> AccessControlStore:
        """Return the store of roster and deny list in the artifact bucket, from where agents fetch both."""
        return AccessControlStore(self._bucket)

    def published(self) -> KeySet:
        """Return the public keys that servers fetch; raises NotFound if none were published."""
        return KeySet.from_json(self._bucket.get(KEYS_NAME).decode())

    def publish(self, ring: KeyRing) -> None:
        """Write the public keys of *ring* to the bucket; servers fetch them within `spread_s`.

        If roster or deny list do not exist, create empty ones before.
        """
        self.access_control_store().create_missing()
        self._bucket.put(KEYS_NAME, ring.key_set().to_json().encode())


def open_key_store(account: Account, names: ResourceNames) -> KeyStore:
    """Return the store of the deployment *names* in *account*; raises ConfigurationError if there is none."""
    return KeyStore(
        account,
        secret=account.resource(names.stack("Data"), "AWS::SecretsManager::Secret", "SigningKey"),
        bucket=account.resource(names.stack("Data"), "AWS::S3::Bucket", "Artifacts"),
    )
