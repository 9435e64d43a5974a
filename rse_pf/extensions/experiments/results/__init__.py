"""The records of a run, and the figures that are computed from them.

The modules read and write files of records and compute figures; none of them starts a platform or robots.
"""
