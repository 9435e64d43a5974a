"""Limits of what a robot may use: bytes before decoding, rates, queues, and processes that it crashed.

How many bytes a tenant may store is `rse_pf.storage.quotas`.
"""
