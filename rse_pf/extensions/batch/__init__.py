"""Work that outgrows a process: a merge cut into parts, which several processes or machines compute.

A part is named by the digest of what it computes from, and its result is kept in the store under this name.
So a part is computed once, whatever is killed meanwhile, and by any process with the same result.  What a
part computes belongs to `rse_pf.services`; long commands of robots belong to `rse_pf.server.jobs`.
"""
