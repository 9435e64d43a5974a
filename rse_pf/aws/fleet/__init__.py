"""The Auto Scaling group and its instances: the agent, the lifecycle hook, metrics.

Everything about running servers belongs here; objects and secrets belong to `storage`.
"""
