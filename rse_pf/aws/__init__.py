"""What runs on AWS beside the platform's own code; the only package that imports boto3 and botocore.

Clients, the account and its stacks are here; `fleet` watches servers, `storage` keeps objects, `money`
counts cost.
"""
