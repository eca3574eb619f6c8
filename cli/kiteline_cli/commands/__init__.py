"""One file a subcommand: each loads its room only when it is called."""
