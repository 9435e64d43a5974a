"""The map server: the process that serves one live map; `process` is its entry point, `map_server` its rules.

How a worker starts this process and connects to it belongs to `rse_pf.server.live_map`, and the map itself,
without processes, to `rse_pf.live_map`.
"""
