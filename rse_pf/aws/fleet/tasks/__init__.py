"""The tasks of the agent, one module each; the table that names them is in `rse_pf.aws.fleet.agent`."""
