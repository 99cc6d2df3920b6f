"""The command line and the compositions of the parts."""
