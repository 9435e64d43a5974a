"""Persistent data on AWS: objects in S3, signing keys, archived audit logs.

Servers and their agents belong to `rse_pf.aws.fleet`.
"""

from rse_pf.aws.storage.s3_store import S3Store, open_bucket, open_data_store

__all__ = ["S3Store", "open_bucket", "open_data_store"]
