"""The `kiteline` command."""
