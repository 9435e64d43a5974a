"""An object store in one S3 bucket, with the contract of `rse_pf.storage.object_store.ObjectStore`.

A compare-and-swap is a conditional write of S3, so that only one of two servers succeeds.  A presigned URL
fixes name, length and sha256 of the object that may be stored, so that a robot can upload only these bytes
with it.  Objects whose names the platform would not write are not listed.  The timeouts and retries are those
of `rse_pf.aws.clients`.
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

# HTTP statuses of S3's answers.
_NOT_FOUND = 404
_PRECONDITION_FAILED = 412
_RANGE_NOT_SATISFIABLE = 416
# Least size of the parts of a large object: S3 takes 5 MiB or more, and one or two parts are held in memory.
_PART_BYTES = 8 << 20
_FULL_CODES = {"QuotaExceeded", "EntityTooLarge", "InsufficientStorage"}  # error codes that mean "no space"
_ARCHIVED_CODE = "InvalidObjectState"  # error code for an object that S3 must restore before it can be read
_RENEW = "renew the AWS credentials of this machine: sign in again, or give it a role"
_REFUSAL_HINTS = {
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
"""The hint of the error by S3's error code; other codes get a hint to check the policies."""


def open_bucket(bucket: str, region: str) -> S3Store:
    """Return the store in *bucket*, without a call to AWS; raises MissingExtra if boto3 is not installed."""
    return S3Store(make_client("s3", region), bucket)


def open_data_store(settings: PlatformSettings) -> ObjectStore:
    """Return the store that ``data.store`` names: a folder, memory, or ``s3:BUCKET``.

    Raises:
        UsageError: ``data.store`` names no store.
        MissingExtra: It names a bucket, and boto3 is not installed.
    """
    return open_store(settings.data.store, {"s3": lambda bucket: open_bucket(bucket, settings.cloud.region)})


class S3Store:
    """The objects of one S3 bucket, as an `ObjectStore`."""

    def __init__(self, client: Any, bucket: str) -> None:
        self._client = client
        self._bucket = bucket
        self._has_listed = False
        """Whether a list of the bucket succeeded, so that "not found" cannot mean a missing bucket."""

    def get(self, name: str) -> bytes:
        """Return the bytes of an object; raises NotFound, or Archived if S3 must restore the object first."""
        return self._read(name)[0]

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return at most *length* bytes of an object from *start* on; b"" beyond its end; raises NotFound."""
        from botocore.exceptions import ClientError

        if length <= 0:
            return b""

        with _raise_store_errors(name):
            try:
                return self._get(check_name(name), Range=f"bytes={start}-{start + length - 1}")[0]
            except ClientError as error:
                if status_of(error) == _RANGE_NOT_SATISFIABLE:
                    return b""
                raise

    def put(self, name: str, data: bytes) -> None:
        """Store *data* as the object *name*, durably; raises StoreFull or another StoreError."""
        self._write(check_name(name), data)

    def put_pieces(self, name: str, pieces: Iterator[bytes]) -> None:
        """Store the joined *pieces* as one object, durably, by an upload in parts if they are large.

        If *pieces* raises an error, nothing is stored, and the error is raised.
        """
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
        """Return size and name of an object; raises NotFound."""
        try:
            answer = self._ask(name, "head_object", Key=check_name(name))
        except (NotFound, StoreRefused) as error:
            # S3's answer to HEAD has no body and so no error code.  A list raises the cause, if there is
            # one, such as a missing bucket.
            if isinstance(error, StoreRefused) or not self._has_listed:
                self._ask(name, "list_objects_v2", Prefix=name, MaxKeys=1)
                self._has_listed = True
            raise
        return ObjectInfo(name=name, size=int(answer["ContentLength"]))

    def list(self, prefix: str = "", after: str = "") -> Iterator[ObjectInfo]:
        """Yield the objects whose names begin with *prefix* and are greater than *after*, sorted by name."""
        for page in self._pages(prefix, **({"StartAfter": after} if after else {})):
            for row in page.get("Contents", ()):
                with contextlib.suppress(StoreError):  # skips names that the platform would not write
                    yield ObjectInfo(name=check_name(row["Key"]), size=int(row["Size"]))

    def folders(self, prefix: str) -> Iterator[str]:
        """Yield the names of the folders directly below *prefix*, sorted: the text up to the next slash."""
        for page in self._pages(prefix, Delimiter="/"):
            for row in page.get("CommonPrefixes", ()):
                yield str(row["Prefix"])[len(prefix) : -1]

    def usage(self, prefix: str) -> Usage:
        """Return the number and the charged bytes of all objects below *prefix*; all are listed for this."""
        return usage_of(self.list(prefix))

    def delete(self, name: str) -> None:
        """Remove the object; a missing object is no error."""
        with contextlib.suppress(NotFound):
            self._ask(name, "delete_object", Key=check_name(name))

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        """Store *data* if the object still holds *expected* (None: it does not exist), else raise Conflict.

        If S3's answer to a successful write was lost, the retry finds its own data, which is no conflict.
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
        """Return a URL and headers for one PUT that stores the object, without credentials; no call is made.

        Args:
            name: Name of the object.
            size: Length of the object in bytes.
            sha256: Digest of the object in hexadecimal; S3 refuses other bytes.
            ttl_s: Validity of the URL in seconds.
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
        """Return a URL from which the object may be read without credentials for *ttl_s* seconds."""
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
    """Join *pieces* and yield them in parts of at least *size* bytes; the last part may be shorter."""
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
        if code == _ARCHIVED_CODE:
            raise Archived(
                f"{name!r} is archived and cannot be read now",
                hint=f"restore it: aws s3api restore-object --bucket BUCKET --key {name} "
                "--restore-request Days=7",
            ) from error
        if status_of(error) == _NOT_FOUND and code not in _REFUSAL_HINTS:
            raise NotFound(f"no object named {name!r}") from error
        if status_of(error) == _PRECONDITION_FAILED:
            raise _conflict_error(name) from error
        if code in _FULL_CODES:
            raise StoreFull(f"no space for {name!r}", hint="free some space") from error
        hint = _REFUSAL_HINTS.get(code, "check the role's policy and the bucket's")
        what = "the bucket does not exist" if code == "NoSuchBucket" else f"S3 refuses {name!r}: {code}"
        raise StoreRefused(what, hint=hint) from error


def _conflict_error(name: str) -> Conflict:
    return Conflict(f"{name!r} was changed by another writer", hint="read it again and retry")
