"""MCAP logs: typed messages enter and are written; a log, also a cut one, is read back message by message."""
