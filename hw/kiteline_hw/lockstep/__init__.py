"""The barrier of a lock-step flight: per tick one message of each agent enters, the base's answer leaves."""
