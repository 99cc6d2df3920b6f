"""`python -m straitlink`: the same as the console script."""

from straitlink.cli import main

main()
