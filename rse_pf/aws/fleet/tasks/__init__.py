"""The tasks of the agent, one module each.

What an instance repeats for its server belongs here; table and loop belong to `rse_pf.aws.fleet.agent`.
"""
