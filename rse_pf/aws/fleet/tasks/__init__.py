"""The tasks of the agent, one module each.

Work that an instance repeats for its server belongs here; the list of tasks and the loop that calls them
belong to `rse_pf.aws.fleet.agent`.
"""
