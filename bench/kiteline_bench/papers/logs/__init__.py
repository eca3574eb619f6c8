"""Logs of hours of flight enter, are cut anywhere and replayed; bars leave."""
