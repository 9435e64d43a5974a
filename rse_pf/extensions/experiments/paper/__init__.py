"""The experiments of the RSE-PF paper's Section 6: elasticity, robustness, latency and mapping.

This package has the scenarios and the targets of their figures.  The package `results` has the records and
the computation of figures, and `plots` the drawings.
"""
