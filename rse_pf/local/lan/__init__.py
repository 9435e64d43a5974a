"""The address and the certificates of a local platform that other machines of its network may reach.

What a robot or a browser needs to trust the listener belongs here; the listener itself is part of Envoy's
configuration in `balancer`.
"""
