"""Backend, data and rosbridge servers as processes of this machine: start, watch, adopt, replace.

How a process is started and stopped belongs here; how many backend servers there are is decided in `control`.
"""
