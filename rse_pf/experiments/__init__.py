"""Experiments: the demo, and the paper's Section 6 again; they may use every room but the stacks."""
