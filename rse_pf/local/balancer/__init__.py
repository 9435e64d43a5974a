"""The load balancer on one machine: Envoy and its configuration.

Only Envoy belongs here; which servers it sends robots to is decided in `control`.
"""
