"""Links between an agent and a base: packets in, packets out, over Zenoh or a serial line; opened by name."""
