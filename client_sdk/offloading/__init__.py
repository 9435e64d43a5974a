"""Who computes a pose: a server, the burst function, or the robot itself.

How a command travels belongs to `client_sdk.network`, the services that a robot computes itself to
`client_sdk.offloading.local_services`.
"""
