"""Long commands of robots: leases in the store, processes, and their turn on a server.

What a job computes belongs to `rse_pf.services`; anything that answers within a frame belongs to
`scheduling`.  What operators compute in parts belongs to `rse_pf.extensions.batch`.
"""
