"""The tasks of the agent, one module each.

What an instance repeats for its server belongs here; the table and the loop belong to `rse_pf.aws.fleet.agent`.
"""
