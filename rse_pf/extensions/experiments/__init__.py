"""Experiments: the demo, the load generator, and the experiments of the RSE-PF paper's Section 6.

The modules of this package may import every package but `stacks`.  Code that robots or servers need at run
time does not belong here.
"""
