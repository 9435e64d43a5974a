"""The shared library of the native core; `rse_pf.native` finds the library in the folder of this module."""
