"""Services that an operator installs in Python, C/C++ or Lua: their folders and runtimes.

How a service folder is read and run belongs here; the isolation around it belongs to
`rse_pf.server.sandbox`.
"""
