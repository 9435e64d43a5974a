"""The command line: ``rse-pf VERB``, one file for each verb.

Options and printed text belong here; what a verb does belongs in the package it calls.
"""
