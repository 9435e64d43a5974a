"""The demo: robots build maps through a platform on this machine.

This package has the robots of the demo, their keyframes, the merge of their maps, and the report.  Errors and
other figures are computed in `rse_pf.extensions.experiments.results`.
"""
