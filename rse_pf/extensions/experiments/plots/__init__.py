"""PNG images of experiment runs, maps and trajectories.

This package draws; the package `results` computes the numbers that are drawn.
"""
