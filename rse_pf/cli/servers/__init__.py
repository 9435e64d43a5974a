"""The verbs serve and data, which run one server each, and the program of a warm standby process.

Options and printed text belong here; the servers themselves are in `rse_pf.server` and `rse_pf.data_server`.
"""
