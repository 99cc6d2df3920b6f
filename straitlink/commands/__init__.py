"""The commands, by what they work on: options in, results out; each imports its heavy parts when it runs."""
