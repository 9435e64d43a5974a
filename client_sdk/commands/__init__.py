"""Types that a program receives from a robot: answers, updates of subscribed topics, traffic statistics.

The messages on the wire and their rules belong to `rse_pf.wire`.  Sending belongs to `client_sdk.network`.
"""
