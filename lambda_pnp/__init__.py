"""Pose estimation without a server: the PnP service as an AWS Lambda function."""
