"""A local platform that robots of the same network may reach: its address and certificates.

What a robot or a browser needs to trust the listener belongs here; the listener itself is in `balancer`.
"""
