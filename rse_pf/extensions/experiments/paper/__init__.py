"""Section 6 of the paper, again: elasticity, robustness, latency, mapping.

Scenarios and what they must show belong here; records and figures are in `results` and `plots`.
"""
