"""The life of a deployment: it is put up, parked, resumed and taken down, each by a plan of steps.

A plan depends only on the resources that exist in the account, and every step may be repeated.  A
command that was ended at any moment is therefore finished by the same command.
"""
