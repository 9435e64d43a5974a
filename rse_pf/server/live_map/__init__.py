"""Live maps on a server: the process that owns a map, and the way of robots' commands and updates to it.

The map itself is `rse_pf.live_map`; here are its lease, its log in the object store, and the connections.
"""
