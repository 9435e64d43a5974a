"""The platform on one machine, box by box after the paper's Fig. 2, in processes of this user.

Starts servers with the command that a cloud instance runs; never imports `rse_pf.server`.
"""
