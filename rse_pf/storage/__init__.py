"""Bytes that outlive a process: files, objects under names, leases, and the quotas of tenants.

S3 as an object store is in `rse_pf.aws`; what maps and recordings mean is not known here.
"""
