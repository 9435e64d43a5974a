"""Records of a run, what follows from them, and the check that a report follows from its records.

Pure functions over records belong here; starting anything does not.
"""
