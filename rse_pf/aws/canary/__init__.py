"""The canary of a deployment: an AWS Lambda function that requests one known pose each minute.

It connects through the load balancer, as a robot does.  The handler belongs here; its schedule and its alarm
are in the stacks.
"""
