"""The command ``rse-pf check``: track a drive on this machine, and show its faults.

The faults are found by `client_sdk.check`.
"""
