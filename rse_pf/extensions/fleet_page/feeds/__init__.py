"""What the page knows, and where it reads it: the control plane, servers, logs, live maps.

What browsers may ask for and do belongs to the package above.
"""
