"""Limits of what a robot may take: bytes before decoding, rates, queues, and processes that it ended.

How many bytes a tenant may store is `rse_pf.storage.quotas`.
"""
