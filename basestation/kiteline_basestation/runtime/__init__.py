"""The base as a process: options and links enter; logs, map files, reports and status messages leave."""
