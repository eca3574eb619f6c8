"""Real and worn recordings enter; what the product makes of them, and what it costs, leaves as bars."""
