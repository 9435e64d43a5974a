"""The verb check, which tracks a drive on this machine and shows what is wrong with it.

How faults are found belongs to `client_sdk.check`.
"""
