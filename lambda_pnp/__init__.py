"""Pose estimation without a server: the PnP service as an AWS Lambda function.

The entry point, its keys and its answers belong here; the solver is `rse_pf.pnp`.
"""
