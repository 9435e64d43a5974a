"""The native core of RSE-PF; `rse_pf.native` loads the library beside this file."""
