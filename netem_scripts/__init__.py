"""The thin link: in virtual time and as a UDP proxy."""
