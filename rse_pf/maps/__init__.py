"""Maps that robots share: their format, the registry of versions, and files for other programs.

Algorithms that build or join maps belong to `rse_pf.slam`; HTTP belongs to `rse_pf.data_server`.
"""
