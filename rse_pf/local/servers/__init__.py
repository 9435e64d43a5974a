"""Backend and data servers as processes of this machine: start, watch, adopt, replace.

Processes belong here; decisions about how many there are belong to `control`.
"""
