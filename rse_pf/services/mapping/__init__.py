"""The mapping services: alignment, place recognition, localisation, map merge and pose graphs.

Requests, replies and their limits belong here; algorithms belong to `rse_pf.slam`, storage to `rse_pf.maps`.
"""
