"""Experiments: the demo, the load generator, and the experiments of the paper's Section 6.

They may use every package but `stacks`; what robots or servers need at run time belongs elsewhere.
"""
