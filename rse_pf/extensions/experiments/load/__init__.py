"""A load generator: many robots in a few processes.

What the robots send and measure belongs here; judging a run belongs to `paper`.
"""
