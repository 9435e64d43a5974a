"""Run the process that serves one live map; `process` is its entry point, and `map_server` has its rules.

What a worker does to reach or start this process is in the package above.  The map itself is
`rse_pf.live_map`.
"""
