"""Fuzzing of everything that reads bytes from outside; see docs/security.md. Not part of the package."""
