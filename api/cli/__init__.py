"""The `sgsst` command. This module imports nothing: Ctrl-C may arrive while the command's imports run."""

#: Exit code after Ctrl-C, as in shells, and what is printed then.
INTERRUPTED, ABORTED = 130, "Aborted. Output files are complete or were not written."
