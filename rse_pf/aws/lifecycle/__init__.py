"""Deploy, park, resume and remove a deployment on AWS, each by a plan of steps.

A plan depends only on the resources that exist in the account, and every step may be repeated.  A command
that was interrupted at any moment is therefore completed by calling it again.
"""
