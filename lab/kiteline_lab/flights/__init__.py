"""Sources enter; agents and a base fly them in this process or as child processes; a folder of results leaves."""
