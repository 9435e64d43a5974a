"""An object store in one S3 bucket, with the contract of `rse_pf.storage.object_store.ObjectStore`.

A compare-and-swap is a conditional write of S3, so only one of two servers succeeds.  A presigned URL fixes
name, length and sha256 of what may be stored, so a robot can upload exactly these bytes with it.  Names that
the platform would not write are not listed; no call lasts longer than `rse_pf.aws.clients` allows.
"""

from __future__ import annotations

import base64
import contextlib
import itertools
from collections.abc import Iterator
from typing import Any

from rse_pf.aws.clients import error_code, make_client, status_of, with_retries
from rse_pf.config import PlatformSettings
from rse_pf.errors import Archived, Conflict, NotFound, StoreError, StoreFull, StoreRefused
from rse_pf.storage.object_store import ObjectInfo, ObjectStore, Usage, check_name, open_store, usage_of

__all__ = ["S3Store", "open_bucket", "open_data_store"]

# HTTP statuses of S3.
_NOT_FOUND = 404
_PRECONDITION_FAILED = 412
_RANGE_OUTSIDE = 416
# Size of the parts of a large object: S3 takes 5 MiB or more, and one part is held in memory.
_PART_BYTES = 8 << 20
_FULL = {"QuotaExceeded", "EntityTooLarge", "InsufficientStorage"}
_ARCHIVED = "InvalidObjectState"
_RENEW = "renew the AWS credentials of this machine: sign in again, or give it a role"
_REFUSED = {
    "NoSuchBucket": "correct data.store, or deploy the data stack",
    "RequestTimeTooSkewed": "set the clock of this machine: S3 accepts at most 15 minutes of difference",
    **dict.fromkeys(
        (
            "ExpiredToken",
            "InvalidAccessKeyId",
            "InvalidToken",
            "SignatureDoesNotMatch",
            "TokenRefreshRequired",
        ),
        _RENEW,
    ),
}
"""Error code of S3 to the hint; every other code gets a hint at the policies."""


def open_bucket(bucket: str, region: str) -> S3Store:
    """Return the store in *bucket* without a call to AWS; raises MissingExtra."""
    return S3Store(make_client("s3", region), bucket)


def open_data_store(settings: PlatformSettings) -> ObjectStore:
    """Return the store of ``data.store``, which may be a bucket; raises UsageError or MissingExtra."""
    return open_store(settings.data.store, {"s3": lambda bucket: open_bucket(bucket, settings.cloud.region)})


class S3Store:
    """Objects of one bucket."""

    def __init__(self, client: Any, bucket: str) -> None:
        self._client = client
        self._bucket = bucket
        self._has_listed = False
        """Whether a list of the bucket succeeded, so that a missing object is no missing bucket."""

    def get(self, name: str) -> bytes:
        """Return the object; raises NotFound, or Archived if a rule of the bucket has archived it."""
        return self._read(name)[0]

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return at most *length* bytes from *start* on; raises NotFound."""
        from botocore.exceptions import ClientError

        if length <= 0:
            return b""

        with _raise_store_errors(name):
            try:
                return self._get(check_name(name), Range=f"bytes={start}-{start + length - 1}")[0]
            except ClientError as error:
                if status_of(error) == _RANGE_OUTSIDE:
                    return b""
                raise

    def put(self, name: str, data: bytes) -> None:
        """Store the object durably; raises StoreFull."""
        self._write(check_name(name), data)

    def put_pieces(self, name: str, pieces: Iterator[bytes]) -> None:
        """Store the object durably, in parts of `_PART_BYTES`; if *pieces* raises an error, store nothing."""
        parts = _join_pieces(pieces, _PART_BYTES)
        first, second = next(parts, b""), next(parts, None)
        if second is None:
            self.put(name, first)
            return
        upload = self._ask(name, "create_multipart_upload", Key=check_name(name))["UploadId"]
        try:
            sent = []
            for number, part in enumerate(itertools.chain([first, second], parts), 1):
                answer = self._ask(
                    name, "upload_part", Key=name, UploadId=upload, PartNumber=number, Body=part
                )
                sent.append({"PartNumber": number, "ETag": answer["ETag"]})
            self._ask(
                name, "complete_multipart_upload", Key=name, UploadId=upload, MultipartUpload={"Parts": sent}
            )
        except BaseException:
            with contextlib.suppress(StoreError):
                self._ask(name, "abort_multipart_upload", Key=name, UploadId=upload)
            raise

    def head(self, name: str) -> ObjectInfo:
        """Return size and name; raises NotFound."""
        try:
            answer = self._ask(name, "head_object", Key=check_name(name))
        except (NotFound, StoreRefused) as error:
            # The answer to HEAD has no body, and so no code: a list names the cause, as a missing bucket.
            if isinstance(error, StoreRefused) or not self._has_listed:
                self._ask(name, "list_objects_v2", Prefix=name, MaxKeys=1)
                self._has_listed = True
            raise
        return ObjectInfo(name=name, size=int(answer["ContentLength"]))

    def list(self, prefix: str = "", after: str = "") -> Iterator[ObjectInfo]:
        """Yield the objects whose names begin with *prefix* and are greater than *after*, sorted by name."""
        for page in self._pages(prefix, **({"StartAfter": after} if after else {})):
            for row in page.get("Contents", ()):
                with contextlib.suppress(StoreError):  # a name that the platform did not write
                    yield ObjectInfo(name=check_name(row["Key"]), size=int(row["Size"]))

    def folders(self, prefix: str) -> Iterator[str]:
        """Yield the parts of names between *prefix* and the next slash, sorted."""
        for page in self._pages(prefix, Delimiter="/"):
            for row in page.get("CommonPrefixes", ()):
                yield str(row["Prefix"])[len(prefix) : -1]

    def usage(self, prefix: str) -> Usage:
        """Return the usage of the objects below *prefix*, of which all are listed."""
        return usage_of(self.list(prefix))

    def delete(self, name: str) -> None:
        """Remove the object; a missing one is no error."""
        with contextlib.suppress(NotFound):
            self._ask(name, "delete_object", Key=check_name(name))

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        """Replace the object if it still holds *expected* (None: is missing); raises Conflict.

        When the answer to a successful write is lost, the retry finds its own data and succeeds, too.
        """
        check_name(name)
        condition = {"IfNoneMatch": "*"}
        if expected is not None:
            try:
                current, tag = self._read(name)
            except NotFound as error:
                raise _conflict_error(name) from error
            if current != expected:
                raise _conflict_error(name)
            condition = {"IfMatch": tag}
        self._write(name, data, **condition)

    def presigned_put(self, name: str, *, size: int, sha256: str, ttl_s: int) -> tuple[str, dict[str, str]]:
        """Return a URL and the headers with which exactly these bytes may be PUT there.

        Args:
            name: Name of the object.
            size: Its length in bytes.
            sha256: Its digest in hex; S3 refuses other bytes.
            ttl_s: The address is good for so long.
        """
        checksum = base64.b64encode(bytes.fromhex(sha256)).decode()
        url = self._client.generate_presigned_url(
            "put_object",
            Params={
                "Bucket": self._bucket, "Key": check_name(name), "ContentLength": size,
                "ChecksumSHA256": checksum,
            },
            ExpiresIn=ttl_s,
        )  # fmt: skip
        return str(url), {"Content-Length": str(size), "x-amz-checksum-sha256": checksum}

    def presigned_get(self, name: str, *, ttl_s: int) -> str:
        """Return an address from which the object may be read for *ttl_s* seconds."""
        place = {"Bucket": self._bucket, "Key": check_name(name)}
        return str(self._client.generate_presigned_url("get_object", Params=place, ExpiresIn=ttl_s))

    def _pages(self, prefix: str, **arguments: str) -> Iterator[dict[str, Any]]:
        while True:
            page = self._ask(prefix, "list_objects_v2", Prefix=prefix, **arguments)
            yield page
            if not page.get("IsTruncated"):
                return
            arguments["ContinuationToken"] = page["NextContinuationToken"]

    def _read(self, name: str) -> tuple[bytes, str]:
        check_name(name)
        with _raise_store_errors(name):
            return self._get(name)

    def _get(self, name: str, **more: str) -> tuple[bytes, str]:
        def get() -> tuple[bytes, str]:
            answer = self._client.get_object(Bucket=self._bucket, Key=name, **more)
            return answer["Body"].read(), answer["ETag"]

        return with_retries(get)

    def _write(self, name: str, data: bytes, **condition: str) -> None:
        tries = 0

        def write() -> None:
            nonlocal tries
            tries += 1
            self._client.put_object(Bucket=self._bucket, Key=name, Body=data, **condition)

        try:
            with _raise_store_errors(name):
                with_retries(write)
        except Conflict:
            if tries == 1 or self.get(name) != data:
                raise

    def _ask(self, name: str, method: str, **arguments: Any) -> dict[str, Any]:
        with _raise_store_errors(name):
            answer: dict[str, Any] = with_retries(
                lambda: getattr(self._client, method)(Bucket=self._bucket, **arguments)
            )
        return answer


def _join_pieces(pieces: Iterator[bytes], size: int) -> Iterator[bytes]:
    """Yield what *pieces* hold in parts of at least *size* bytes, the last one excepted."""
    part = bytearray()
    for piece in pieces:
        part += piece
        if len(part) >= size:
            yield bytes(part)
            part.clear()
    if part:
        yield bytes(part)


@contextlib.contextmanager
def _raise_store_errors(name: str) -> Iterator[None]:
    from botocore.exceptions import ClientError

    try:
        yield
    except ClientError as error:
        code = error_code(error)
        if code == _ARCHIVED:
            raise Archived(
                f"{name!r} is archived and cannot be read now",
                hint=f"restore it: aws s3api restore-object --bucket BUCKET --key {name} "
                "--restore-request Days=7",
            ) from error
        if status_of(error) == _NOT_FOUND and code not in _REFUSED:
            raise NotFound(f"no object named {name!r}") from error
        if status_of(error) == _PRECONDITION_FAILED:
            raise _conflict_error(name) from error
        if code in _FULL:
            raise StoreFull(f"no space for {name!r}", hint="free some space") from error
        hint = _REFUSED.get(code, "check the role's policy and the bucket's")
        what = "the bucket does not exist" if code == "NoSuchBucket" else f"S3 refuses {name!r}: {code}"
        raise StoreRefused(what, hint=hint) from error


def _conflict_error(name: str) -> Conflict:
    return Conflict(f"{name!r} was changed by another writer", hint="read it again and retry")
