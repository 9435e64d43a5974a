"""The verbs serve and data, which run one server each, and the process of a warm standby.

How a server works belongs to `rse_pf.server` and `rse_pf.data_server`.
"""
