"""One agent in a process: options, a source, packets and controller messages enter; poses and a log leave."""
