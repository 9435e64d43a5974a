"""What a deployment costs on AWS: an estimate from one dated table of prices.

Nothing here calls AWS.
"""
