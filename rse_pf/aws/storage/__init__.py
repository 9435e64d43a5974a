"""What AWS keeps: objects in S3, keys and secrets, archived audit logs.

Everything that outlives a server belongs here; instances belong to `fleet`.
"""

from rse_pf.aws.storage.s3_store import S3Store, open_bucket
from rse_pf.aws.storage.secrets import read_secret, write_secret

__all__ = ["S3Store", "open_bucket", "read_secret", "write_secret"]
