"""Which view is worth its bits: renders sensors down to what an operator asked for."""
