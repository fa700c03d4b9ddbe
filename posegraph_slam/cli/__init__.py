"""The command `psg`."""
