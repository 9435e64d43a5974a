"""The owner of a live map: its lease, its log, what it does with requests, and its process.

How a worker reaches an owner belongs to `rse_pf.server.live_map`, the map itself to `rse_pf.live_map`.
"""
