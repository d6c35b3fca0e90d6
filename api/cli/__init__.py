"""The `sgsst` command."""
