"""The use of AWS services; the only package that imports boto3 and botocore.

Clients, the account and its stacks are here; `fleet` operates servers, `storage` keeps objects, `lifecycle`
deploys, parks and removes a deployment, and `canary` asks for a known pose.
"""
