"""What AWS costs: the estimate, account quotas, and resources left behind.

Only reads and estimates belong here; nothing in this package creates a resource.
"""
