"""The use of AWS services; the only package that imports boto3 and botocore.

This package itself makes clients and reads the account and its stacks.  `fleet` operates servers, `storage`
keeps objects, `lifecycle` deploys, parks and removes a deployment, and `canary` checks a deployment by a
request for a known pose.
"""
