"""Child processes of the platform: how one is started, limited, spoken to and ended.

A child is a new interpreter that runs one function and has one socket to its parent.  Servers, which may
outlive what started them, are `rse_pf.local.processes`; workers are forked from their supervisor.
"""
