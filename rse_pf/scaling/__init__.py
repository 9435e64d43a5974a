"""Pure rules of scaling: when servers count as busy, idle or unhealthy, and how the fleet changes then.

Decisions on values belong here; the code that measures, starts and stops servers does not.
"""
