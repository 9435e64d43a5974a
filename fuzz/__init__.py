"""Fuzzing of everything that a stranger's bytes reach; see docs/security.md. Not part of the package."""
