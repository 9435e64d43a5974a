"""What runs on AWS beside the platform's own code: objects in S3, secrets, and the machine's agent."""

from rse_pf.aws.s3_store import S3Store, open_bucket
from rse_pf.aws.secrets import read_secret, write_secret

__all__ = ["S3Store", "open_bucket", "read_secret", "write_secret"]
