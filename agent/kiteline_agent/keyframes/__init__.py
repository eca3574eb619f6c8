"""Makes keyframes: a tracked frame enters, records for the base and new landmarks of the local map leave."""
