"""The life of a deployment: it is put up, parked, resumed and taken down, each by a plan of steps.

A plan is made from what stands in the account and from nothing else, and every step may be repeated.  A
command that was ended at any moment is therefore finished by the same command.
"""
