"""The command line: ``rse-pf VERB``, one file per verb, everything heavy imported inside the verb."""
