"""Pure rules of scaling: when servers count as busy, idle or unhealthy, and what to do then.

Decisions on values belong here; measuring, starting and stopping servers do not.
"""
