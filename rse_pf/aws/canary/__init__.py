"""The canary of a deployment: a function that asks for one known pose through the load balancer each minute.

The handler belongs here; its schedule and its alarm are in the stacks.
"""
