"""Store the maps that robots share: their file format, the registry of their versions, and backups.

Algorithms that build or merge maps are in `rse_pf.slam`; HTTP requests are served by `rse_pf.data_server`.
"""
