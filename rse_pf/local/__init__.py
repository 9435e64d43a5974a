"""The platform on one machine: each box of the paper's Fig. 2 runs in processes of this user.

Servers are started with the command that an instance on AWS runs; this package never imports `rse_pf.server`.
"""
