"""Build the wheel ``rse-pf-native`` from the sources beside it, with the standard library and a compiler."""
