"""Compare configurations of the tracker on recordings: ``rse-pf compare``.

What tracks belongs to `client_sdk`; the formulas of the errors belong to
`rse_pf.extensions.experiments.results`."""
