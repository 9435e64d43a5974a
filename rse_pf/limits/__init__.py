"""Limits of what a robot may use: sizes of messages, rates, places in queues, and processes that it crashed.

The limits of what robots and tenants may store are in `rse_pf.storage.quotas`.
"""
