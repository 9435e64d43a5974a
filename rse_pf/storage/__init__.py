"""Storage that outlives a process: files, objects under names, leases, and the quotas of tenants.

S3 as an object store is in `rse_pf.aws`.  This package does not interpret the maps and recordings that it
stores.
"""
