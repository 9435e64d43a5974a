"""Long commands of robots as jobs: leases in the store, processes, and slots of a server.

The services that jobs run belong to `rse_pf.services`; services that answer within a frame belong to
`scheduling`. Merges that operators distribute over several machines belong to `rse_pf.extensions.batch`.
"""
