"""Estimate what a deployment costs on AWS, from one dated table of prices.

This package does not call AWS.
"""
