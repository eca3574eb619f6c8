"""Tools behind the commands for files and machines: a file, store or base goes in, a file or a report comes out."""
