"""The Auto Scaling group and its instances: the agent, lifecycle hooks, metrics, logs and upgrades.

Everything about running servers belongs here; objects and secrets belong to `rse_pf.aws.storage`.
"""
