"""Pose estimation without a server: the PnP service as an AWS Lambda function.

The function's entry point, its cache of public keys and its answers belong here; the solver is `rse_pf.pnp`.
"""
