"""Compare configurations of the tracker on recordings: ``rse-pf compare``.

The tracker is in `client_sdk`, and the computation of errors in `rse_pf.extensions.experiments.results`.
"""
